"""Drawing of a scene in a camera's image."""
