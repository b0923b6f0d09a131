"""What a new installation waits for: the compiling of loops, in CPU seconds of each.

    python -m benchmarks.start --compile [--product tile|shade|sunhours|point|render] [--file FILE] [--rows 40]

Each product is made once, in a fresh process with an empty cache of compiled loops: a first tile after a render process has
started, or what a command writes, of a made raster of mountains (``render``: of the bundled wooded level). Machines are compared
by the yardstick: the CPU seconds of compiling one fixed small loop in the same process.
"""

from __future__ import annotations

import argparse

from benchmarks.compile_profile import PRODUCTS, profile_of, table_of


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compile", action="store_true", required=True, help="profile the compiling of loops")
    parser.add_argument("--product", choices=PRODUCTS, help="default: all")
    parser.add_argument("--file", help="a raster or a level")
    parser.add_argument("--rows", type=int, default=40, help="lines of each table")
    args = parser.parse_args()
    for product in [args.product] if args.product else PRODUCTS:
        print("\n".join(table_of(product, profile_of(product, args.file), args.rows)), flush=True)


if __name__ == "__main__":
    main()
