"""How kernels (`pipistrelle.jit`) that call each other become machine code: once, and together.

Numba compiles each function to machine code, and again within each function that calls it, and so
on up. Here a kernel that kernels call is brought into LLVM's language only; with the kernel that
Python calls it is optimised and becomes machine code, which takes half the time.

Files of compiled kernels, each with its sum: what was cut or changed is compiled anew.

Numba keeps a kernel (what `pipistrelle.jit` compiles) in two files, an index and its code, and runs
whatever it finds there. Here each ends in the SHA-256 of what stands before it, which Numba does
not look at when it reads them.
"""

import gc
import sys
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

from pipistrelle.kernel_folder import TURN

_said: set[str] = set()
"""What was said once need not be said for every kernel."""


class CheckedFiles(IndexDataCacheFile):
    """A kernel's two files."""

    def load(self, key: Any) -> Any:
        """Load a kernel; None if it must be compiled, for which it is this process's turn."""
        found = super().load(key)
        if found is None:
            TURN.take(Path(self._index_path))
            found = super().load(key)  # another process may have kept it meanwhile
        return found

    def save(self, key: Any, data: Any) -> None:
        """Keep what was compiled, if there is room: without it, it is compiled again next time."""
        try:
            super().save(key, data)
        except OSError as error:
            _say(
                f"{Path(self._cache_path).parent}: compiled kernels could not be kept "
                f"({error.strerror}), so they are compiled at every start; make room or set "
                "NUMBA_CACHE_DIR"
            )

    def _load_index(self) -> dict[Any, str]:
        """Load the index of kernels; it is empty where the file is damaged."""
        return super()._load_index() if self._is_sound(Path(self._index_path)) else {}

    def _load_data(self, name: str) -> Any:
        """Return a kernel's code; Numba takes an error for a file that is gone."""
        if not self._is_sound(Path(self._data_path(name))):
            raise FileNotFoundError(name)
        return super()._load_data(name)

    def _is_sound(self, path: Path) -> bool:
        """Tell whether a file is as it was written, or is not there; remove any other."""
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
        _say(f"{path.parent.parent}: compiled kernels were damaged, and are compiled anew")
        with suppress(OSError):
            path.unlink()
        return False

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:  # pyrefly: ignore[bad-override]
        """Write a file, and its sum after it."""
        buffer = BytesIO()
        yield buffer
        content = buffer.getvalue()
        with super()._open_for_write(filepath) as file:
            file.write(content + sha256(content).digest())


def checked(dispatcher: Any) -> Any:
    """Let a compiled function keep its code in checked files.

    They are named after the function, and neither after its line nor after the folder of the
    package: the folder of kernels belongs to one state of all code. Where compilation is switched
    off, the function itself takes the dispatcher's place.
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


def _say(line: str) -> None:
    """Print a message once."""
    if line not in _said:
        _said.add(line)
        with suppress(OSError, AttributeError):  # there is no reader
            print(f"pipistrelle: {line}", file=sys.stderr)


TESTED = (0, 68)
"""The newest Numba whose private classes are known to be as they are taken here."""


class Kernel(CPUDispatcher):
    """A compiled function; the kernels that call it see its linked form."""

    def __init__(self, function: Any, options: dict[str, Any], *, twice: bool) -> None:
        pipeline = _Compiling if twice else _CompilingOnce
        super().__init__(function, targetoptions=options, pipeline_class=pipeline)

    @cached_property
    def linked(self) -> CPUDispatcher:
        """The same function, without machine code of its own."""
        return CPUDispatcher(
            self.py_func, targetoptions=self.targetoptions, pipeline_class=_Linking
        )

    @property
    def _numba_type_(self) -> types.Dispatcher:
        """What a kernel that calls this one sees."""
        return types.Dispatcher(self.linked)

    def compile(self, sig: Any) -> Any:
        """Load, or compile in turn, without collecting garbage: it takes a seventh of the time."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super().compile(sig)
        finally:
            TURN.end()
            if collecting:
                gc.enable()


class _CodeOnce(JITCodeLibrary):
    """The machine code of a kernel with all that it calls."""

    def _finalize_specific(self) -> None:
        """Compile, and tell the linked kernels their environments, as Numba does when it loads."""
        super()._finalize_specific()
        for variable in self._final_module.global_variables:
            if (environment := lookup_environment(variable.name)) is not None:
                self._codegen.set_env(variable.name, environment)  # pyrefly: ignore[missing-attribute]


class _Code(_CodeOnce):
    """The same, optimised twice: what is called, then what became of it in its callers."""

    def _optimize_final_module(self) -> None:
        """Optimise twice."""
        super()._optimize_final_module()
        super()._optimize_final_module()


class _LinkedCode(JITCodeLibrary):
    """The code of a linked kernel in LLVM's language, not optimised."""

    @property
    def codegen(self) -> Any:
        """What is told the kernel's environment: nothing here needs it."""
        return self

    def set_env(self, *_: Any) -> None:
        """Leave the environment to the machine code's library."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return no address, as there is no machine code."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        """Leave it as it is."""

    def _finalize_final_module(self) -> None:
        """Be ready to be linked."""
        self._finalized = True


class _Compiling(Compiler):
    """Numba's compiler, with a library of ours for the code."""

    library: type[JITCodeLibrary] = _Code

    def define_pipelines(self) -> Any:
        """Make the library, and return Numba's passes, which use one that is there."""
        state = self.state
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super().define_pipelines()


class _CompilingOnce(_Compiling):
    """The same with code that is optimised once."""

    library = _CodeOnce


class _Linking(_Compiling):
    """The same for a linked kernel, which Python never calls."""

    library = _LinkedCode

    def define_pipelines(self) -> Any:
        """Leave out the wrapper for Python, too."""
        self.state.flags.no_cpython_wrapper = True
        return super().define_pipelines()


def check() -> None:
    """Compile a kernel that calls another, by a Numba that is newer than any tested; or raise."""
    if numba.version_info.short <= TESTED:
        return
    called = Kernel(_halved, {"nopython": True}, twice=True)

    def calling(x: float) -> float:
        return called(x) + called(x + 1.0)

    found = Kernel(calling, {"nopython": True}, twice=False)(3.0)
    if found != 3.5:
        raise ArithmeticError(f"found {found}, expected 3.5")


def _halved(x: float) -> float:
    """Be compiled within another."""
    return 0.5 * x
