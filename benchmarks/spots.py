"""`python -m benchmarks.spots`: how many rods a fixed threshold and `auto` find beside bright things."""

from __future__ import annotations

from support.beside_bright_things import BESIDE, compare


def main() -> None:
    """Print the table of rods found beside bright things."""
    print("beside                    rods  fixed  auto  lost by auto  other spots: fixed  auto")
    for beside in BESIDE:
        found = compare(beside, 20)
        print(
            f"{beside.name:24s} {found.rods:5d}  {found.fixed:5d} {found.auto:5d}  {found.lost:12d}  "
            f"{found.others_fixed:18d} {found.others_auto:5d}"
        )


if __name__ == "__main__":
    main()
