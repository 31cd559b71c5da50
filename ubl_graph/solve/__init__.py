"""Solvers: what turns a Problem and a start into an estimate with covariances."""
