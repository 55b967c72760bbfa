"""The bodies of objects, which have a shape, a size and a heading, and the boxes around them."""
