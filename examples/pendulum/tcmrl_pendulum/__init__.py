"""Plug-ins for tcmrl: a pendulum whose physics differ from task to task, and NumPy archives."""
