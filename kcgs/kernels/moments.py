"""Gradients from moments: plain arithmetic, on tensors, in compiled loops, and in Triton programs."""


def geometry_gradient(s1, s2, s11, s12, s22, l11, l21, l22):
    """Return the gradients of x, y, l11, l21 and l22, of the sums of v (z1, z2, z1 z1, z1 z2, z2 z2)."""
    slope = l21 / l22
    return (s1 - slope * s2) / l11, s2 / l22, (s11 - slope * s12) / l11, s12 / l22, s22 / l22
