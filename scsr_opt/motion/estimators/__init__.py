"""Estimators of the motion, one a module, and the evidence by which `Automatic` chooses among them."""
