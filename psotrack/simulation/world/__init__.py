"""What there is to see: drones, and rooms with their light."""
