"""Diagnosis: signs of wrong units, signs, channels and sensors in a log."""

from jaxid.diagnose.diagnosis import Diagnosis as Diagnosis
from jaxid.diagnose.diagnosis import diagnose as diagnose
