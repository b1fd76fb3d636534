"""A small compiler: from a function of a few scalars to fused XLA, NumPy, Python, or C.

It knows nothing about robots. `trace` runs an ordinary JAX function on scalars that
fold constants and merge equal expressions; the remaining sequence of operations is a
`Program`. `lower` runs it in JAX, `evaluate` in NumPy, `to_python` on single floats;
`CWriter` writes it in C.
"""

from .c_writer import CWriter as CWriter
from .jax_sincos import sine_cosine as sine_cosine
from .numpy_evaluation import (
    evaluate as evaluate,
    evaluate_rows as evaluate_rows,
    packed_entries as packed_entries,
    to_python as to_python,
)
from .program import (
    OperationCounts as OperationCounts,
    Program as Program,
    Shape as Shape,
    select_outputs as select_outputs,
)
from .trace import FREE as FREE, trace as trace
from .xla import (
    Lowered as Lowered,
    kernel_options as kernel_options,
    lower as lower,
    on_any_platform as on_any_platform,
)
