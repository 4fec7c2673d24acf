"""Speed of the live viewer."""
