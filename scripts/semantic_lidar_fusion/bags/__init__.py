# SPDX-License-Identifier: MIT
"""Bags, the clouds and poses in them, and what a replay leaves."""
