"""The paper's experiments: `kcgs bench charts`, `davis`, `ablation`, `convergence`."""
