"""From images to features, matches between them, and tracks held out for testing."""
