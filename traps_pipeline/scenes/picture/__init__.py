"""Camera, rendering, encoding, and the pixel checks of a simulated world."""
