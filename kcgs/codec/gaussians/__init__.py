"""Gaussians as whole numbers, in layers."""
