"""Linking of kernels (`pipistrelle.jit`): callees as LLVM code, compiled once with their caller.

Numba compiles each function to machine code, and again within each caller. Here a kernel that is
called by kernels is only translated to LLVM's language; it is optimised and compiled with the
kernel that Python calls, in half the time.

Numba caches a kernel in two files, an index and its code, and executes them unchecked. Here each
file ends with the SHA-256 of its content, which Numba ignores when reading; a damaged file is
removed, and its kernel compiled again.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from stat import S_ISREG
from typing import Any

import numba
from numba.core import types
from numba.core.caching import IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.environment import lookup_environment
from numba.core.registry import CPUDispatcher

from pipistrelle.kernel_folder import TURN, say


class CheckedFiles(IndexDataCacheFile):
    """The files that cache a compiled kernel, each with a checksum."""

    def load(self, key: Any) -> Any:
        """Load a kernel from the cache; None, with its lock taken, if it must be compiled."""
        found = super().load(key)
        if found is None:
            TURN.take(Path(self._index_path))
            found = super().load(key)  # another process may have saved it meanwhile
        return found

    def save(self, key: Any, data: Any) -> None:
        """Save a compiled kernel in the cache; without room it is compiled again next time."""
        try:
            super().save(key, data)
        except OSError as error:
            say(
                f"{Path(self._cache_path).parent}: compiled kernels could not be kept "
                f"({error.strerror}), so they are compiled at every start; make room or set "
                "NUMBA_CACHE_DIR"
            )

    def _load_index(self) -> dict[Any, str]:
        """Load the index of a function's cached kernels; empty if the file is damaged."""
        return super()._load_index() if self._is_sound(Path(self._index_path)) else {}

    def _load_data(self, name: str) -> Any:
        """Load a cached kernel's code; raise if the file is damaged, as Numba then compiles."""
        if not self._is_sound(Path(self._data_path(name))):
            raise FileNotFoundError(name)
        return super()._load_data(name)

    def _is_sound(self, path: Path) -> bool:
        """Return whether a cache file is undamaged or missing; remove a damaged file."""
        try:
            state = path.stat()
            if S_ISREG(state.st_mode):  # a pipe would be waited for
                found = path.read_bytes()
                if sha256(found[:-32]).digest() == found[-32:]:
                    return True
        except FileNotFoundError:
            return True
        except OSError:
            return False
        say(f"{path.parent.parent}: compiled kernels were damaged, and are compiled again")
        with suppress(OSError):
            path.unlink()
        return False

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:  # pyrefly: ignore[bad-override]
        """Yield a buffer, and write it to a cache file with its checksum at the end."""
        buffer = BytesIO()
        yield buffer
        content = buffer.getvalue()
        with super()._open_for_write(filepath) as file:
            file.write(content + sha256(content).digest())


def checked(dispatcher: Any) -> Any:
    """Make a compiled function use cache files with checksums.

    They are named only after the function, without its line and the package's folder, as the cache
    folder belongs to one state of all code. If compilation is disabled, `dispatcher` is the
    function itself.
    """
    if cache := getattr(dispatcher, "_cache", None):
        function = dispatcher.py_func
        root = Path(numba.config.CACHE_DIR)  # pyrefly: ignore[missing-attribute]
        folder, made = root / function.__module__, Path(cache.cache_path)
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            if made.parent == root:  # by Numba, just now
                made.rmdir()
        cache._impl.locator._cache_path = cache._cache_path = str(folder)
        cache._cache_file = CheckedFiles(str(folder), function.__qualname__, "")
    return dispatcher


TESTED = (0, 68)
"""The newest Numba version with known private classes."""


class Kernel(CPUDispatcher):
    """A compiled function that other kernels include as LLVM code when they call it."""

    def __init__(self, function: Any, options: dict[str, Any], *, twice: bool) -> None:
        pipeline = _Compiling if twice else _CompilingOnce
        super().__init__(function, targetoptions=options, pipeline_class=pipeline)

    @cached_property
    def linked(self) -> CPUDispatcher:
        """The same function compiled only to LLVM code, for its callers."""
        return CPUDispatcher(
            self.py_func, targetoptions=self.targetoptions, pipeline_class=_Linking
        )

    @property
    def _numba_type_(self) -> types.Dispatcher:
        """The Numba type that kernels use to call this function as LLVM code."""
        return types.Dispatcher(self.linked)

    def compile(self, sig: Any) -> Any:
        """Load or compile a kernel while garbage collection is off, which saves time."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super().compile(sig)
        finally:
            TURN.end()
            if collecting:
                gc.enable()


class _CodeOnce(JITCodeLibrary):
    """Code library of a kernel: the machine code of the kernel and all that it calls."""

    def _finalize_specific(self) -> None:
        """Compile the library, and set the Numba environments of the kernels linked into it."""
        super()._finalize_specific()
        for variable in self._final_module.global_variables:
            if (environment := lookup_environment(variable.name)) is not None:
                self._codegen.set_env(variable.name, environment)  # pyrefly: ignore[missing-attribute]


class _Code(_CodeOnce):
    """Code library with machine code optimised twice: callees, then their code in callers."""

    def _optimize_final_module(self) -> None:
        """Optimise the LLVM code twice."""
        super()._optimize_final_module()
        super()._optimize_final_module()


class _LinkedCode(JITCodeLibrary):
    """Code library of a kernel that others call: unoptimised LLVM code."""

    @property
    def codegen(self) -> Any:
        """Return this library, which receives and ignores the kernel's environment."""
        return self

    def set_env(self, *_: Any) -> None:
        """Ignore the kernel's environment, as the caller's machine code has it."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0 in place of the function's address, as there is no machine code."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        """Leave the LLVM code unoptimised, as its callers optimise it."""

    def _finalize_final_module(self) -> None:
        """Mark the LLVM code as ready to be linked into its callers."""
        self._finalized = True


class _Compiling(Compiler):
    """Numba's compiler with a code library of this module."""

    library: type[JITCodeLibrary] = _Code

    def define_pipelines(self) -> Any:
        """Create the code library, and return Numba's compiler passes, which use it."""
        state = self.state
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super().define_pipelines()


class _CompilingOnce(_Compiling):
    """Numba's compiler for kernels that are optimised only once."""

    library = _CodeOnce


class _Linking(_Compiling):
    """Numba's compiler to LLVM code, for a kernel that only other kernels call."""

    library = _LinkedCode

    def define_pipelines(self) -> Any:
        """Return Numba's compiler passes without a wrapper for calls from Python."""
        self.state.flags.no_cpython_wrapper = True
        return super().define_pipelines()


def check() -> None:
    """Compile a test kernel if Numba is newer than the tested versions; raise if it fails."""
    if numba.version_info.short <= TESTED:
        return
    called = Kernel(_halved, {"nopython": True}, twice=True)

    def calling(x: float) -> float:
        return called(x) + called(x + 1.0)

    found = Kernel(calling, {"nopython": True}, twice=False)(3.0)
    if found != 3.5:
        raise ArithmeticError(f"found {found}, expected 3.5")


def _halved(x: float) -> float:
    """Return half of a number: the test kernel that another kernel calls."""
    return 0.5 * x
