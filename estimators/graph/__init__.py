"""Smoothers on GTSAM's factor graphs; the only folder that imports gtsam."""
