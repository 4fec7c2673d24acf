"""The page that shows a certificate to people."""
