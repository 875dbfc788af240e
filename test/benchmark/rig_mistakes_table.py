#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Makes the ordinary mistakes of test/python/rig_mistakes.py on a simulated drive and prints which of
them check_rig.py names, and of which fuse_bag alone warns.

  plain: two cameras, clouds with a time per point, tf
  reference: the five cameras of the reference rig, the same otherwise
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile

HERE = os.path.dirname(os.path.abspath(__file__))
SOURCE_DIR = os.path.dirname(os.path.dirname(HERE))
sys.path[:0] = [os.path.join(SOURCE_DIR, "scripts"), os.path.join(SOURCE_DIR, "test", "python")]


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin-dir", required=True, help="folder of fuse_bag and simulate_drive")
    parser.add_argument("--vehicle", choices=("plain", "reference"), default="plain")
    parser.add_argument("--simulate", default="--duration 2 --scale 0.25 --seed 31")
    parser.add_argument("--only", default="", help="regular expression of the mistakes' names")
    parser.add_argument("--fuse-only", action="store_true", help="leave check_rig.py out")
    parser.add_argument("--keep", help="folder for the reports")
    return parser


def ran(command):
    """(exit code, stdout and stderr)."""
    done = subprocess.run(
        [str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    return done.returncode, done.stdout


def checked(options, bag, rig, out):
    """(exit code, findings) of check_rig.py."""
    script = os.path.join(SOURCE_DIR, "scripts", "check_rig.py")
    program = os.path.join(options.bin_dir, "fuse_bag")
    code, text = ran(
        [sys.executable, script, bag, "--rig", rig, "--out", out, "--fuse-bag", program]
    )
    path = os.path.join(out, "findings.json")
    if not os.path.exists(path):
        return code, [{"verdict": "wrong", "cause": text[-400:], "figure": "", "sensor": ""}]
    with open(path) as file:
        return code, json.load(file)


def warned(options, bag, rig, out):
    """What fuse_bag alone says of a rig; "" if nothing."""
    code, text = ran([os.path.join(options.bin_dir, "fuse_bag"), bag, out, "--force", "--rig", rig])
    lines = [line for line in text.splitlines() if "warning:" in line or "error:" in line]
    return "; ".join(re.sub(r"fuse_bag: (warning|error): ", "", line) for line in lines)


def main():
    options = make_parser().parse_args()
    import rig_mistakes
    import yaml

    classes = os.path.join(SOURCE_DIR, "config", "classes_usyd12.yaml")
    demo = os.path.join(SOURCE_DIR, "config", "demo.yaml")
    with tempfile.TemporaryDirectory() as folder:
        drive, raw, bag, rig, out = (
            os.path.join(folder, name)
            for name in ("drive.bag", "raw.bag", "in.bag", "rig.yaml", "out.bag")
        )
        simulate = [os.path.join(options.bin_dir, "simulate_drive"), "--quiet", "--out", drive]
        fuse = [os.path.join(options.bin_dir, "fuse_bag"), drive, raw, "--rig", demo, "--quiet"]
        for command in (
            simulate + options.simulate.split(),
            fuse + ["--set", "motion.enabled=false"],
        ):
            code, text = ran(command)
            if code:
                sys.exit(text)
        sources = rig_mistakes.VEHICLES[options.vehicle]
        items = rig_mistakes.plain_bag(drive, raw, sources)
        tree = rig_mistakes.rig(classes, sources)
        right = rig_mistakes.Mistake("none", "")
        named = told = 0
        wanted = [m for m in rig_mistakes.ALL if re.search(options.only, m.name)]
        for mistake in [right] + wanted:
            made, changed = mistake.made(items, tree)
            rig_mistakes.write(bag, made)
            with open(rig, "w") as file:
                yaml.safe_dump(changed, file)
            warning = warned(options, bag, rig, out)
            told += bool(warning) and mistake is not right
            line = "%-30s fuse_bag: %-8s" % (mistake.name, "warns" if warning else "-")
            if not options.fuse_only:
                report = os.path.join(options.keep or folder, mistake.name.replace(" ", "_"))
                code, found = checked(options, bag, rig, report)
                bad = [f for f in found if f["verdict"] in ("suspect", "wrong")]
                hit = [
                    f
                    for f in bad
                    if mistake.cause
                    and mistake.named_in(
                        " ".join(f.get(k, "") for k in ("cause", "figure", "cure"))
                    )
                ]
                named += bool(hit)
                verdict = "named" if hit else "NOT NAMED" if bad else "ok"
                line += " check_rig: %-9s (exit %d)" % (verdict, code)
                for f in hit[:1] or bad[:3]:
                    line += "\n    %s: %s" % (f["sensor"], f.get("cause") or f.get("figure"))
            print(line + ("\n    fuse_bag: " + warning[:300] if warning else ""), flush=True)
        print("fuse_bag warns of %d of %d" % (told, len(wanted)))
        if not options.fuse_only:
            print("check_rig.py names %d of %d" % (named, len(wanted)))


if __name__ == "__main__":
    main()
