"""The coder of Gaussians: they become whole numbers, and are written in layers."""
