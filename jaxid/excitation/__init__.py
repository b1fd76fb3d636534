"""Design of motions that determine the base parameters well (Eq. 36)."""

from . import constraints as constraints, criteria as criteria
from .compiled_search import CompiledSearch as CompiledSearch
from .design import (
    design_excitation as design_excitation,
    minimise as minimise,
)
from .design_result import (
    DesignProgress as DesignProgress,
    DesignStatus as DesignStatus,
    ExcitationPlan as ExcitationPlan,
)
from .motions_on_feet import Standing as Standing
from .problem import ExcitationProblem as ExcitationProblem
