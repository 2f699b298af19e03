"""Parts of published methods: GaussianImage's optimizer, and the warm-up of the paper."""
