"""Reads mutated files: a reader returns, or says in an InputError what is wrong, within time and memory."""

import resource
import shutil
import signal
import warnings
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz.mutations import edited, edits
from warpav.core.errors import InputError

SECONDS_MAX = 5.0  # of processor time
MEGABYTES_MAX = 2000


class OvertimeError(BaseException):
    """The reader takes too long; no reader catches it."""


def _interrupt(*_):
    raise OvertimeError


def fuzz(kind, folder, count, *, is_random=False):
    """Read ``count`` mutated samples of a kind; the first that goes wrong fails, and says where its bytes are."""
    sample = kind.write(folder)
    kind.read(sample)  # it is valid
    parts = [sample] if sample.is_file() else sorted(file for file in sample.rglob("*") if file.is_file())
    if sample.is_file() and kind.name.startswith("rig "):
        parts = sorted(file for file in sample.parent.rglob("*") if file.is_file())
    original = {file: file.read_bytes() for file in parts}
    unpack, pack = kind.inner or (bytes, bytes)

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        derandomize=not is_random,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink) if not is_random else (Phase.generate,),
    )
    @given(st.sampled_from(parts), edits)
    def read(part, done):
        part.write_bytes(pack(edited(unpack(original[part]), done)))
        try:
            _read_once(kind, sample)
        except (Exception, OvertimeError) as error:
            kept = Path(shutil.copy(part, folder.parent / f"failed-{part.name}"))
            raise AssertionError(
                f"{kind.name}: {part.name}, kept as {kept}: {type(error).__name__}: {error}"
            ) from error
        finally:
            part.write_bytes(original[part])

    read()


def _read_once(kind, sample):
    previous = signal.signal(signal.SIGPROF, _interrupt)
    signal.setitimer(signal.ITIMER_PROF, SECONDS_MAX)
    before = _megabytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(sample)
    except InputError:
        pass
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, previous)
    after = _megabytes()  # beside what tests before left in the process
    assert after < max(MEGABYTES_MAX, before + 100), f"{after} MB"


def _megabytes():
    """The most memory that this process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
