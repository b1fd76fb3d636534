"""Diagnosis: signs of wrong units, signs, channels and sensors in a log."""

from jaxid.diagnosis.diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
