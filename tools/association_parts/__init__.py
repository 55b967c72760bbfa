"""The parts of bench_association.py: the scenes that association is judged by. Each prints what it measured."""
