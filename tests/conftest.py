"""What every test shares: the debug mode of the binding is on, and few threads are used."""

import os

os.environ.setdefault("AST_SIM_DEBUG", "1")
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # a thread that waits leaves its core to the other tests
