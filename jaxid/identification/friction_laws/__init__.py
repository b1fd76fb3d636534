"""Constants of friction laws: presliding lengths, transition and Stribeck speeds."""

from .presliding_lengths import identify_presliding as identify_presliding
from .stribeck_speeds import identify_stribeck_speeds as identify_stribeck_speeds
from .transition_speeds import (
    identify_transition_speeds as identify_transition_speeds,
)
