"""What the object and its surroundings look like: colours, shader nodes and printed images."""
