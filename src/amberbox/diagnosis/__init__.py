"""Diagnosis: from symptoms to ranked causes, by FMEA, covering, fault trees and rules."""
