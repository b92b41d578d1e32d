"""Convert a picture to WebP: a palette would show steps in the gradients of depth images.

usage: python -m benchmarks.webp IN.png OUT.webp"""

import sys

from PIL import Image

if __name__ == "__main__":
    Image.open(sys.argv[1]).save(sys.argv[2], quality=90, method=6)
