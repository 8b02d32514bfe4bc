"""Solvers: one file per backend, the outer loops, the certificate and the comparison.

Nothing heavy is imported here; see :mod:`factorgrasp.solvers.registry` for the names.
"""
