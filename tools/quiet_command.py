# SPDX-License-Identifier: Apache-2.0
"""
Run a command that writes nothing until its end, and show the elapsed time meanwhile.

Run as ``python -m tools.quiet_command COMMAND...``.
"""

from pathlib import Path
import subprocess
import sys

from needle_insertion.progress import ProgressLine


def main(words: list[str]) -> int:
    """Run the command, write its output, and return its exit status."""
    with ProgressLine(' '.join([Path(words[0]).name, *words[1:]]), brief=True):
        result = subprocess.run(
            words, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
    sys.stdout.buffer.write(result.stdout)
    return result.returncode


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
