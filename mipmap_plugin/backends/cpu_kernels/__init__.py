"""The compiled half of the CPU backend, and the only place that imports numba.

What numba counts references of (arrays, and records that hold some) is taken apart where a kernel begins: a count is an atomic
operation, and one for each splat costs more than all of its geometry. Inside, numbers travel alone or in tuples.
"""

import numba

# Division by zero gives infinity as in numpy; the kernels' callers run them side by side in threads.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
