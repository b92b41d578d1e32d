"""Fast-Grasp'D (Turpin et al., ICRA 2023): descent through a differentiable contact simulation."""
