"""Diagnosis: signs of wrong units, signs, channels and sensors in a log."""

from jaxid.diagnosis.diagnosis import Diagnosis as Diagnosis
from jaxid.diagnosis.diagnosis import diagnose as diagnose
