"""BOReL: a policy that acts by its belief of the task."""
