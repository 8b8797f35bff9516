"""Freeze the golden values anew: `python tests/golden/freeze.py [group ...]`, all if none is named.

Only after a change that is meant to change them.
"""

import sys
import time

import numpy as np
import values


def main(groups):
    for group in groups or values.GROUPS:
        began = time.perf_counter()
        frozen = values.compute(group)
        np.savez_compressed(values.path_of(group), **frozen)
        seconds, size = time.perf_counter() - began, values.path_of(group).stat().st_size
        print(f"{group}: {len(frozen)} fields, {size / 1000:.1f} kB, {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
