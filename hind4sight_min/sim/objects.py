"""What lies in the arena: prisms of random size over one to three convex outlines, with drawn textures.

Nothing here needs Bullet. Paper: Sec. IV-B, objects that "differ in geometry, size and texture and have varying
physical properties"; the shapes and textures are ours. An outline has its corners (n, 2) in m, counter-clockwise.
"""
import cv2
import numpy as np

# --- shapes -------------------------------------------------------------------------------------------------------

def rectangle(x0, y0, x1, y1):
    """The outline of a rectangle."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def regular(sides, radius):
    """The outline of a regular polygon about the origin."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# kind -> outlines of some sizes (several touch each other and are rectangles); ranges of these sizes, of the height and
# of what the top is scaled by (None: 1); density in kg/m^3, range of the friction coefficient
KINDS = {
    "carton": (lambda a, b: [rectangle(-a, -b, a, b)],
               [(0.028, 0.042), (0.020, 0.028)], (0.035, 0.060), None, 700.0, (0.45, 0.60)),
    "can": (lambda radius: [regular(20, radius)],
            [(0.024, 0.034)], (0.045, 0.070), None, 1400.0, (0.55, 0.70)),
    "bracket": (lambda a, b: [rectangle(0, 0, a, b), rectangle(0, b, b, a)],
                [(0.065, 0.085), (0.024, 0.030)], (0.030, 0.045), None, 1000.0, (0.60, 0.80)),
    "pot": (lambda radius: [regular(6, radius)],
            [(0.030, 0.042)], (0.035, 0.055), (0.6, 0.8), 1800.0, (0.50, 0.65)),
    "wedge": (lambda a, b: [np.array([[0, 0], [a, 0], [a / 3, b]])],
              [(0.060, 0.085), (0.050, 0.070)], (0.030, 0.055), None, 1200.0, (0.50, 0.75)),
    "cross": (lambda a, b: [rectangle(-a, -b, a, b), rectangle(-b, b, b, a), rectangle(-b, -a, b, -b)],
              [(0.034, 0.044), (0.012, 0.016)], (0.030, 0.045), None, 900.0, (0.50, 0.70)),
    # Stands on its edge and topples now and then.
    "book": (lambda a, b: [rectangle(-a, -b, a, b)],
             [(0.028, 0.036), (0.0075, 0.0095)], (0.060, 0.070), (0.75, 0.95), 700.0, (0.70, 0.95)),
}


def draw_shape(kind, rng):
    """A random object of a kind -> its outlines about the common centroid, their area in m^2, its height in m, and the
    taper that its top is scaled by.
    """
    outlines, sizes, heights, tapers, _, _ = KINDS[kind]
    outlines, area = centred(outlines(*[rng.uniform(*size) for size in sizes]))
    return outlines, area, rng.uniform(*heights), rng.uniform(*tapers) if tapers else 1.0


def centred(outlines):
    """Outlines moved so that their common centroid is the origin, and their total area in m^2."""
    areas, centroids = [], []
    for outline in outlines:
        ahead = np.roll(outline, -1, axis=0)
        cross = outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1]
        areas.append(cross.sum() / 2)
        centroids.append(((outline + ahead) * cross[:, None]).sum(axis=0) / (6 * areas[-1]))
    centroid = np.average(centroids, axis=0, weights=areas)
    return [outline - centroid for outline in outlines], sum(areas)


def prism(outline, height, taper):
    """Vertices (2n, 3) of a convex prism: its base at -height/2, then its top, scaled by `taper`."""
    return np.concatenate([np.column_stack([outline * scale, np.full(len(outline), z)])
                           for scale, z in ((1, -height / 2), (taper, height / 2))])


TEXTURE_SIZE = 0.08  # m; the renderer repeats a texture beyond that


def mesh(outlines, height, taper):
    """The prisms' faces for the renderer, flat-shaded -> lists of vertices, normals, texture coordinates, indices.

    Texture coordinates are not negative, where the renderer would not repeat.
    """
    vertices, normals, uvs, indices = [], [], [], []
    for outline in outlines:
        body, n = prism(outline, height, taper), len(outline)
        sides = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1) / TEXTURE_SIZE
        along, up = np.concatenate([[0], np.cumsum(sides)]), height / TEXTURE_SIZE
        faces = [(body[n:], (outline * taper / TEXTURE_SIZE + 1).tolist())]
        faces += [(body[n - 1::-1], (outline[::-1] / TEXTURE_SIZE + 1).tolist())]  # the base, from below
        faces += [(body[[i, (i + 1) % n, n + (i + 1) % n, n + i]],
                   [[along[i], 0], [along[i + 1], 0], [along[i + 1], up], [along[i], up]]) for i in range(n)]
        for corners, uv in faces:
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            indices += [len(vertices) + k for i in range(1, len(corners) - 1) for k in (0, i, i + 1)]
            vertices += corners.tolist()
            normals += [(normal / np.linalg.norm(normal)).tolist()] * len(corners)
            uvs += uv
    return vertices, normals, uvs, indices


# --- textures -----------------------------------------------------------------------------------------------------

TEXTURES = ("stripes", "checks", "dots", "patches", "rings", "zigzag")
HELD_OUT = {"kinds": ("wedge", "cross"), "textures": ("rings", "zigzag")}  # never in the defaults


def draw_texture(name, rng, size=64):
    """A random texture of one of TEXTURES -> (size, size, 3) uint8 RGB, with features that small pictures can show.

    Raises ValueError for other names.
    """
    hue = rng.uniform(0, 180)
    hsv = [[hue, rng.uniform(120, 255), rng.uniform(150, 255)],
           [(hue + rng.uniform(40, 140)) % 180, rng.uniform(60, 255), rng.uniform(60, 200)]]
    first, second = cv2.cvtColor(np.uint8([hsv]), cv2.COLOR_HSV2RGB)[0].tolist()
    image = np.full((size, size, 3), first, np.uint8)
    y, x = np.mgrid[:size, :size]
    step = size // int(rng.integers(2, 4))
    half = step // 2
    if name == "stripes":
        image[x % step < half] = second
    elif name == "checks":
        image[(y - x // half % 2 * half) % step < half] = second
    elif name == "dots":
        for centre in [(u, v) for u in range(half, size, step) for v in range(half, size, step)]:
            cv2.circle(image, centre, step // 3, second, -1)
    elif name == "patches":
        for _ in range(5):
            centre, axes = rng.integers(0, size, 2), rng.integers(size // 8, size // 4, 2)
            cv2.ellipse(image, centre.tolist(), axes.tolist(), rng.uniform(0, 180), 0, 360, second, -1)
    elif name == "rings":
        for radius in range(step // 3, size, half):
            cv2.circle(image, (size // 2, size // 2), radius, second, step // 6)
    elif name == "zigzag":
        for top in range(-step, size + step, step):
            corners = [[u, top + half * (i % 2)] for i, u in enumerate(range(0, size + step, half))]
            cv2.polylines(image, [np.int32(corners)], False, second, step // 4)
    else:
        raise ValueError(f"texture: expected one of {', '.join(TEXTURES)}, got {name!r}")
    return image
