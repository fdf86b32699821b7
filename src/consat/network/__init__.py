"""Agents on a network: one process each, which knows its own constraints, its neighbours' names and addresses, and nothing else."""
