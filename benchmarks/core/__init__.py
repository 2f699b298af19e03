"""What experiments have in common: jobs on disk, images, comparisons, figures."""
