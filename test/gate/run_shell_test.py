#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Runs a shell test and writes its outcome as a JUnit result.

usage: run_shell_test.py RESULT.xml SCRIPT [ARGUMENT...]

Exit code 0 of the script is a pass, 77 a skip whose reason is the last line printed, anything
else a failure.
"""

import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ET

SKIP = 77


def clean(text):
    """`text` without the control characters that XML cannot hold."""
    return "".join(c for c in text if c in "\n\t" or ord(c) >= 32)


def main(argv):
    if len(argv) < 3:
        sys.exit(__doc__)
    result, script = argv[1], argv[2]
    name = os.path.splitext(os.path.basename(script))[0]
    start = time.monotonic()
    done = subprocess.run(
        ["/bin/bash"] + argv[2:],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    output = clean(done.stdout.decode("utf-8", "replace")).strip()
    print(output)
    last = output.splitlines()[-1] if output else ""

    failed, skipped = done.returncode not in (0, SKIP), done.returncode == SKIP
    suite = ET.Element(
        "testsuite",
        name=name,
        tests="1",
        failures=str(int(failed)),
        errors="0",
        skipped=str(int(skipped)),
    )
    case = ET.SubElement(
        suite, "testcase", classname="shell", name=name, time="%.3f" % (time.monotonic() - start)
    )
    if failed:
        failure = ET.SubElement(
            case, "failure", message="exit code %d: %s" % (done.returncode, last)
        )
        failure.text = output[-4000:]
    elif skipped:
        ET.SubElement(case, "skipped", message=last)
    os.makedirs(os.path.dirname(os.path.abspath(result)), exist_ok=True)
    ET.ElementTree(suite).write(result, encoding="utf-8", xml_declaration=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
