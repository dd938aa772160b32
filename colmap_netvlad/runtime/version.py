"""The version, where every room can read it without importing the face of the library."""

VERSION = "0.1.0"
