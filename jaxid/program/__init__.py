"""A small compiler: from a function of a few scalars to fused XLA, NumPy, Python, or C.

It knows no robot. `trace` runs an ordinary JAX function on scalars that fold constants and merge
equal expressions; what is left is a straight line of operations, a `Program`.
`lower` runs it in JAX, `evaluate` in NumPy, `to_python` on single
floats; `to_c` writes it down in C.
"""

from jaxid.program.adjoint import Reversible as Reversible
from jaxid.program.c import declaration as declaration
from jaxid.program.c import definition as definition
from jaxid.program.c import to_c as to_c
from jaxid.program.c_library import Library as Library
from jaxid.program.evaluate import evaluate as evaluate
from jaxid.program.evaluate import evaluate_packed as evaluate_packed
from jaxid.program.fence import AbstractFence as AbstractFence
from jaxid.program.fence import BarrierFence as BarrierFence
from jaxid.program.fence import DivisionFence as DivisionFence
from jaxid.program.fence import NoFence as NoFence
from jaxid.program.fence import default_fence as default_fence
from jaxid.program.program import OperationCounts as OperationCounts
from jaxid.program.program import Program as Program
from jaxid.program.program import chosen as chosen
from jaxid.program.python import to_python as to_python
from jaxid.program.sincos import library_sine_cosine as library_sine_cosine
from jaxid.program.sincos import sine_cosine as sine_cosine
from jaxid.program.trace import FREE as FREE
from jaxid.program.trace import applied as applied
from jaxid.program.trace import program_of_scalars as program_of_scalars
from jaxid.program.trace import trace as trace
from jaxid.program.xla import Lowered as Lowered
from jaxid.program.xla import lower as lower
from jaxid.program.xla import unpack as unpack
