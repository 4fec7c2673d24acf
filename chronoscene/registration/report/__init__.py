"""A certificate in; ``registration.json``, and ``registration.html`` with comparisons, out."""
