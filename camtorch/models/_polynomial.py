"""What fisheyes with a polynomial of odd powers have in common."""

from camtorch.camera import Camera


class OddPolynomial(Camera):
    """The coefficients k1 k2 ... of x (1 + k1 x^2 + k2 x^4 + ...), any number of them."""

    distortion_names = ("k1", "k2", "k3", "k4")
    default_count = 4
    fit_counts = (4, 6, 8, 10)

    @classmethod
    def names_of(cls, count):
        return tuple(f"k{i}" for i in range(1, count + 1)) or None

    @classmethod
    def counts_text(cls):
        return "n >= 1 (k1 k2 ...)"
