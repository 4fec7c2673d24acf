"""What stands in a generated city, and how it changes from period to period."""
