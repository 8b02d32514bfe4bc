"""Models: parameters to geometry and to pinocchio models."""
