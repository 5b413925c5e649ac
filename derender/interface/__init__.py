"""What `import derender` offers to Python: the functions and the two objects that they return, and pictures of them."""
