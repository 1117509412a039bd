"""Plug-ins for tcmrl: a pendulum whose physics differ from task to task, a method, and NumPy archives."""
