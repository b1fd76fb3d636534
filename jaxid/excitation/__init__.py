"""Design of motions that determine the base parameters well (Eq. 36)."""

from . import constraints as constraints, criteria as criteria
from .compiled_search import CompiledSearch as CompiledSearch
from .design import (
    DesignProgress as DesignProgress,
    design_excitation as design_excitation,
    minimise as minimise,
)
from .design_result import (
    DesignStatus as DesignStatus,
    ExcitationPlan as ExcitationPlan,
)
from .problem import ExcitationProblem as ExcitationProblem
