# SPDX-License-Identifier: MIT
"""Semantic clouds against a truth: metrics, tables, calibration."""
