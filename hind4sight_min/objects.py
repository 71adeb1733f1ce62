"""What lies in the arena: prisms of random size over one or two convex outlines, with drawn textures.

Nothing here needs Bullet. Paper: Sec. IV-B, objects that "differ in geometry, size and texture and have varying
physical properties"; the shapes and textures are ours.
"""
import cv2
import numpy as np

# --- objects: prisms over one or two convex outlines ---------------------------------------------------

def rectangle(x0, y0, x1, y1):
    """Corners (4, 2), counter-clockwise; everything here is in m."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def regular(sides, radius):
    """Corners (sides, 2) of a regular polygon about the origin, counter-clockwise."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _carton(rng):
    a, b = rng.uniform(0.028, 0.042), rng.uniform(0.020, 0.028)
    return [rectangle(-a, -b, a, b)], rng.uniform(0.035, 0.060), 1.0


def _can(rng):
    return [regular(20, rng.uniform(0.024, 0.034))], rng.uniform(0.045, 0.070), 1.0


def _bracket(rng):
    length, arm = rng.uniform(0.065, 0.085), rng.uniform(0.024, 0.030)
    return [rectangle(0, 0, length, arm), rectangle(0, arm, arm, length)], rng.uniform(0.030, 0.045), 1.0


def _pot(rng):
    return [regular(6, rng.uniform(0.030, 0.042))], rng.uniform(0.035, 0.055), rng.uniform(0.6, 0.8)


def _wedge(rng):
    a, b = rng.uniform(0.060, 0.085), rng.uniform(0.050, 0.070)
    return [np.array([[0, 0], [a, 0], [a / 3, b]])], rng.uniform(0.030, 0.055), 1.0


def _cross(rng):
    a, b = rng.uniform(0.034, 0.044), rng.uniform(0.012, 0.016)
    return ([rectangle(-a, -b, a, b), rectangle(-b, b, b, a), rectangle(-b, -a, b, -b)],
            rng.uniform(0.030, 0.045), 1.0)


# kind -> (function that draws one: outlines in m, height in m, taper; density in kg/m^3; range of friction)
KINDS = {
    "carton": (_carton, 700.0, (0.45, 0.60)),
    "can": (_can, 1400.0, (0.55, 0.70)),
    "bracket": (_bracket, 1000.0, (0.60, 0.80)),
    "pot": (_pot, 1800.0, (0.50, 0.65)),
    "wedge": (_wedge, 1200.0, (0.50, 0.75)),
    "cross": (_cross, 900.0, (0.50, 0.70)),
}

HELD_OUT = {"kinds": ("wedge", "cross"), "textures": ("rings", "zigzag")}  # never in the defaults


def area_and_centroid(outline):
    """Of a polygon with corners (n, 2), counter-clockwise -> area in m^2, centroid (2,) m."""
    x, y = outline.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    return area, ((outline + np.roll(outline, -1, axis=0)) * cross[:, None]).sum(axis=0) / (6 * area)


def centred(outlines):
    """Outlines moved so that their common centroid is the origin, and their total area in m^2."""
    areas, centroids = zip(*[area_and_centroid(o) for o in outlines])
    centroid = np.average(centroids, axis=0, weights=areas)
    return [o - centroid for o in outlines], sum(areas)


def prism(outline, height, taper):
    """Vertices (2n, 3) of a convex prism, its base at -height/2, its top scaled by `taper`."""
    base = np.column_stack([outline, np.full(len(outline), -height / 2)])
    top = np.column_stack([outline * taper, np.full(len(outline), height / 2)])
    return np.concatenate([base, top])


TEXTURE_SIZE = 0.08  # m; the renderer repeats a texture beyond that


def prism_mesh(outline, height, taper):
    """A prism's faces for the renderer, flat-shaded: vertices, normals, texture coordinates, indices."""
    body = prism(outline, height, taper)
    n = len(outline)
    faces = [([n + i for i in range(n)], outline * taper / TEXTURE_SIZE + 1)]  # the top; the base is never seen
    sides = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1) / TEXTURE_SIZE
    along, up = np.concatenate([[0], np.cumsum(sides)]), height / TEXTURE_SIZE
    for i in range(n):
        j = (i + 1) % n
        faces.append(([i, j, n + j, n + i],
                      np.array([[along[i], 0], [along[i + 1], 0], [along[i + 1], up], [along[i], up]])))
    vertices, normals, uvs, indices = [], [], [], []
    for corners, uv in faces:
        points = body[corners]
        normal = np.cross(points[1] - points[0], points[2] - points[1])
        indices += [len(vertices) + k for i in range(1, len(corners) - 1) for k in (0, i, i + 1)]
        vertices += points.tolist()
        normals += [(normal / np.linalg.norm(normal)).tolist()] * len(corners)
        uvs += uv.tolist()  # never negative, where the renderer would not repeat
    return vertices, normals, uvs, indices


# --- textures, drawn with OpenCV ------------------------------------------------------------------------

TEXTURES = ("stripes", "checks", "dots", "patches", "rings", "zigzag")


def draw_texture(name, rng, size=64):
    """A random texture of one style -> (size, size, 3) uint8 RGB, with features big enough for our pictures."""
    hue = rng.uniform(0, 180)
    hsv = [[hue, rng.uniform(120, 255), rng.uniform(150, 255)],
           [(hue + rng.uniform(40, 140)) % 180, rng.uniform(60, 255), rng.uniform(60, 200)]]
    first, second = cv2.cvtColor(np.uint8([hsv]), cv2.COLOR_HSV2RGB)[0].tolist()
    image = np.full((size, size, 3), first, np.uint8)
    step = size // int(rng.integers(2, 4))
    if name == "stripes":
        for x in range(0, size, step):
            cv2.rectangle(image, (x, 0), (x + step // 2 - 1, size), second, -1)
    elif name == "checks":
        for i, x in enumerate(range(0, size, step // 2)):
            for y in range((i % 2) * (step // 2), size, step):
                cv2.rectangle(image, (x, y), (x + step // 2 - 1, y + step // 2 - 1), second, -1)
    elif name == "dots":
        for x in range(step // 2, size, step):
            for y in range(step // 2, size, step):
                cv2.circle(image, (x, y), step // 3, second, -1)
    elif name == "patches":
        for _ in range(5):
            centre = rng.integers(0, size, 2)
            axes = rng.integers(size // 8, size // 4, 2)
            cv2.ellipse(image, centre.tolist(), axes.tolist(), rng.uniform(0, 180), 0, 360, second, -1)
    elif name == "rings":
        for radius in range(step // 3, size, step // 2):
            cv2.circle(image, (size // 2, size // 2), radius, second, step // 6)
    elif name == "zigzag":
        for y in range(-step, size + step, step):
            corners = np.array([[x, y + (step // 2) * (i % 2)] for i, x in enumerate(range(0, size + step, step // 2))])
            cv2.polylines(image, [corners.astype(np.int32)], False, second, step // 4)
    else:
        raise ValueError(f"texture: expected one of {', '.join(TEXTURES)}, got {name!r}")
    return image
