"""The command line: signals, streams and exit statuses.

0: done. 1: done, with failed trials. 2: bad input, explained in a line. 130: interrupted, 143:
terminated; finished work is kept. A traceback is always a bug of Pipistrelle.
"""

import signal
import sys
from collections.abc import Sequence

from pipistrelle.verbs.streams import heard_signals, hold_streams, say


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default of this process, and return its exit status.

    >>> main(["study", "nowhere.toml"])
    2
    """
    words = sys.argv[1:] if arguments is None else arguments
    hold_streams()
    with heard_signals(last=arguments is None) as heard:
        try:
            from pipistrelle.verbs.command_line import obey

            status = obey(words, heard)
        except (Exception, KeyboardInterrupt) as error:
            if not heard and isinstance(error, Exception):
                raise
            say("pipistrelle: interrupted")
            status = 128 + (heard[0] if heard else signal.SIGINT)
    return status


if __name__ == "__main__":
    sys.exit(main())
