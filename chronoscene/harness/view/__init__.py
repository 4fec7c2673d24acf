"""A live viewer of scenes and finished runs in the browser, rendered on this machine."""
