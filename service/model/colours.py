"""Conversion of sRGB and hexadecimal colours to linear RGB."""

Colour = tuple[float, float, float]


def linear_rgb(red: float, green: float, blue: float) -> Colour:
    """Convert sRGB components in 0..1 to linear RGB (IEC 61966-2-1)."""
    r, g, b = (c / 12.92 if c <= 0.04045 else float(((c + 0.055) / 1.055) ** 2.4) for c in (red, green, blue))
    return r, g, b


def linear_rgb_from_hex(code: str) -> Colour:
    """Convert a colour such as `#c8553d` to linear RGB."""
    digits = code.lstrip("#")
    return linear_rgb(*(int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)))
