"""The whole loop: design a mask, observe a scene through turbulence with it, restore the image, compare.

    python experiments/codesign.py                                    # the reference case, a packaged satellite
    python experiments/codesign.py --scene.path model.obj             # any mesh or image
    python experiments/codesign.py --preset paper                     # the method as it was published
    python experiments/codesign.py --smoke                            # everything, tiny, in seconds

The rival is a full pupil that reaches the same spatial frequencies and receives photons in proportion to its area. All
results, figures and TensorBoard events go to one new folder, runs/<name>/. The same as `torchmask codesign`.
"""

from __future__ import annotations

import sys

import tyro

from torchmask.cli.codesign import Config, run, with_presets

__all__ = ["Config", "main", "with_presets"]


def main(config: Config) -> int:
    """Run in a new folder; an interrupted run leaves there what it reached."""
    try:
        run(config)
    except KeyboardInterrupt:
        return 130
    except ValueError as error:
        print(f"codesign: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
