"""From a depth image to candidate structures."""
