"""A small compiler: from a function of a few scalars to fused XLA, NumPy, or C.

It knows no robot. `trace` runs an ordinary JAX function on scalars that fold constants and merge
equal expressions; what is left is a straight line of operations, a `Program`.
`lower` runs it in JAX, `evaluate` in NumPy, `to_c` writes it down in C.
"""

from .c import to_c as to_c
from .evaluate import evaluate as evaluate
from .evaluate import evaluate_packed as evaluate_packed
from .fence import AbstractFence as AbstractFence
from .fence import BarrierFence as BarrierFence
from .fence import DivisionFence as DivisionFence
from .fence import NoFence as NoFence
from .fence import default_fence as default_fence
from .program import OperationCounts as OperationCounts
from .program import Program as Program
from .sincos import library_sine_cosine as library_sine_cosine
from .sincos import sine_cosine as sine_cosine
from .trace import FREE as FREE
from .trace import trace as trace
from .xla import Lowered as Lowered
from .xla import lower as lower
from .xla import unpack as unpack
