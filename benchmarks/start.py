"""Start times of a new installation and a used one, and CPU seconds of compiling each loop.

    python -m benchmarks.start [--wheel-python PATH]
    python -m benchmarks.start --compile [--product tile|shade|sunhours|point|render] [--file FILE] [--rows 40]

The first command prints wall and CPU seconds of whole processes (``benchmarks.start_times``): for a clone, and with
``--wheel-python`` for an environment that has only a wheel by ``make wheel``.

The second command computes each product once, in a fresh process with an empty cache of compiled loops. A product is the first tile
of a render process, or the output of a command, for a generated raster of mountains (for ``render``, the bundled wooded level). A
reference time, the CPU seconds to compile one fixed small loop in the same process, serves to compare machines.
"""

from __future__ import annotations

import argparse
import sys

from benchmarks.compile_profile import PRODUCTS, profile_lines, profile_product
from benchmarks.start_times import measure_and_format


def main() -> None:
    """Print the requested table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compile", action="store_true", help="profile the compilation of loops")
    parser.add_argument("--wheel-python", help="interpreter of an environment that has a wheel")
    parser.add_argument("--product", choices=PRODUCTS, help="default: all")
    parser.add_argument("--file", help="a raster or a level")
    parser.add_argument("--rows", type=int, default=40, help="lines of each table")
    args = parser.parse_args()
    if not args.compile:
        for line in measure_and_format(sys.executable, args.wheel_python):
            print(line, flush=True)
        return
    for product in [args.product] if args.product else PRODUCTS:
        print("\n".join(profile_lines(product, profile_product(product, args.file), args.rows)), flush=True)


if __name__ == "__main__":
    main()
