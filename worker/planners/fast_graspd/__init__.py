"""Fast-Grasp'D (Turpin et al., ICRA 2023): grasps by gradient descent through a differentiable contact simulation."""
