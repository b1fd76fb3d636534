"""Diagnosis: signs of wrong units, signs, channels and sensors in a log."""

from .diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
