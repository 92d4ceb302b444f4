"""What is seen around the object in the scene "workspace": surfaces, distractors, light, and the view of them."""
