"""`python -m colmap_netvlad` is the command `colmap-netvlad`."""

from colmap_netvlad.cli import main

main()
