"""Reports as text, JSON and HTML, and the page of all rules."""
