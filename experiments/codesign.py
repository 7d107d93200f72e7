"""The whole loop: design a mask, observe a scene through turbulence with it, restore the image, compare.

    python experiments/codesign.py                                    # the reference case, a packaged satellite
    python experiments/codesign.py --scene.path model.obj             # any mesh or image
    python experiments/codesign.py --preset paper                     # the method as it was published
    python experiments/codesign.py --smoke                            # everything, tiny, in seconds

It is `torchmask codesign`: see `torchmask.cli.codesign`.
"""

import sys

from torchmask.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["codesign", *sys.argv[1:]]))
