# SPDX-License-Identifier: MIT
"""Public data sets in their own folder layouts -> bags."""
