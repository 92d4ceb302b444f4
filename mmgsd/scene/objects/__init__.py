"""What is rendered: cloths by physics, ropes by geometry, planar objects by their outline or mesh."""
