"""Networks that turn a photo into one global descriptor.

From the inside out: a trunk (`vgg`, `resnet`, `efficientnet_lite`) makes local features, an
aggregation (`aggregation`) makes one vector of them, `whitening` shortens it, `network` holds the
three together, `describe` runs them on photos, `checkpoint` keeps them in one file, and
`catalogue` names the files that ship with the package.
"""
