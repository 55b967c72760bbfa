"""The parts of bench_live.py: what a live session must withstand. Each prints what it measured."""
