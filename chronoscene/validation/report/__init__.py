"""Reports as text, JSON, SARIF and HTML, and the page of all rules."""
