"""What every test runs under: kernels compiled for these very sources, repeatable examples."""

from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

from hypothesis import settings

_loader = SourceFileLoader("dev", str(Path(__file__).with_name("dev")))
_spec = spec_from_loader("dev", _loader)
assert _spec is not None
dev = module_from_spec(_spec)
_loader.exec_module(dev)
dev.use_kernel_cache()

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
