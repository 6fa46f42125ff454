"""From the world to the pixels of a camera."""
