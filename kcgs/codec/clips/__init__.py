"""Clips: scenes one after another, each coded by what changed since the one before (docs/format.md)."""
