"""Start times of a new installation and a used one, and CPU seconds of compiling each loop.

    python -m benchmarks.start [--wheel-python PATH]
    python -m benchmarks.start --compile [--product tile|shade|sunhours|point|render] [--file FILE] [--rows 40]

The first prints a table of wall and CPU seconds of whole processes (``benchmarks.start_times``): those of a clone, and with
``--wheel-python`` those of an environment that has only a wheel by ``make wheel``.

The second makes each product once, in a fresh process with an empty cache of compiled loops. A product is a first tile after a
render process has started, or a command's output, of a generated raster of mountains (``render``: of the bundled wooded level). The
yardstick serves to compare machines. It is the CPU seconds of compiling one fixed small loop in the same process.
"""

from __future__ import annotations

import argparse
import sys

from benchmarks.compile_profile import PRODUCTS, profile_lines, profile_product
from benchmarks.start_times import table


def main() -> None:
    """Print the requested table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compile", action="store_true", help="profile the compiling of loops")
    parser.add_argument("--wheel-python", help="interpreter of an environment that has a wheel")
    parser.add_argument("--product", choices=PRODUCTS, help="default: all")
    parser.add_argument("--file", help="a raster or a level")
    parser.add_argument("--rows", type=int, default=40, help="lines of each table")
    args = parser.parse_args()
    if not args.compile:
        for line in table(sys.executable, args.wheel_python):
            print(line, flush=True)
        return
    for product in [args.product] if args.product else PRODUCTS:
        print("\n".join(profile_lines(product, profile_product(product, args.file), args.rows)), flush=True)


if __name__ == "__main__":
    main()
