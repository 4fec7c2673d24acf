"""``registration.html``: a certificate and its registration in, one page out."""
