"""Criteria: numbers of a motion's information that a design minimises."""

from .criterion import (
    CRITERIA as CRITERIA,
    AbstractCriterion as AbstractCriterion,
    AOptimal as AOptimal,
    ConditionNumber as ConditionNumber,
    DOptimal as DOptimal,
    EOptimal as EOptimal,
)
from .information_matrix import (
    Information as Information,
    information as information,
    standard_deviations as standard_deviations,
)
