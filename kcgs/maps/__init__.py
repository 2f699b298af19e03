"""Label maps as kernels read them."""
