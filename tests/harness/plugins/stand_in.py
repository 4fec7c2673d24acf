"""A program that "trains" by looking at its training set, in any Python without any package.

``train`` writes a model; ``render`` shows each test view the first training photo of its period.
"""

import argparse
import os
import shutil
import sys
import time

parser = argparse.ArgumentParser()
parser.add_argument("command")
for name in ("data", "iterations", "seconds", "seed", "hold", "fail"):
    parser.add_argument(f"--{name}", default="")
options = parser.parse_args()


def lines(file):
    with open(os.path.join(options.data, file)) as text:
        return text.read().splitlines()


if options.command == "train":
    print("training", options.iterations, options.seconds, options.seed, flush=True)
    if options.fail:
        print("CUDA error: no device")
        sys.exit(3)
    while options.hold and os.path.exists(options.hold):
        time.sleep(0.01)
    assert not os.listdir("."), "the output must be empty"
    os.mkdir("model")
    with open("model/points.ply", "w") as file:
        file.write("ply\nformat ascii 1.0\nelement vertex 7\nproperty float x\n")
        file.write("property float y\nproperty float z\nend_header\n")
    with open("model/seed.txt", "w") as file:
        file.write(options.seed)
else:
    tests = lines("sparse/0/test.txt")
    periods = dict(line.split() for line in lines("sparse/split.txt"))
    os.mkdir("images")
    for test in tests:
        like = [n for n in periods if n not in tests and periods[n] == periods[test]]
        shutil.copy(os.path.join(options.data, "images", min(like)), f"images/{test}")
    if os.environ.get("TOY_FORGET"):
        os.remove(f"images/{tests[0]}")
