"""The estimators printed in the papers, as baselines on the same data as the problems of factorgrasp."""
