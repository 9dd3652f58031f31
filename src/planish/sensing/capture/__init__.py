"""What a sensor recorded: manifest, images, calibration files, and what the images of a sequence are good for."""
