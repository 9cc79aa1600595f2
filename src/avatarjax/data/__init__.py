"""Avatars, their motion, ground-truth pictures, and datasets made from them."""
