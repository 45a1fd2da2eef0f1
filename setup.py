"""Builds the C firmware core as an extension; everything else is in pyproject.toml."""

from setuptools import setup

setup(cffi_modules=["firmware_protocol/build_firmware.py:ffi"])
