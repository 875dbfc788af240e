# SPDX-License-Identifier: MIT
"""Figures and plots."""
