//! SO(3): exponential, logarithm, Jacobians. Rotations are perturbed on the right: R <- R Exp(θ).
