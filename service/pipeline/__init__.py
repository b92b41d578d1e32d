"""Actions of users on jobs and datasets, and the controller that carries them out."""
