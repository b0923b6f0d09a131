"""Loops that sample the textures of models: colours, normals and gloss of visible triangles.

A pixel's footprint on a triangle is an ellipse, longer along the line of sight at grazing angles. Textures are filtered over it by
several trilinear samples along its longer axis at the mip level of its shorter axis (J. McCormack et al. 1999, "Feline: fast
elliptical lines for anisotropic texture mapping").
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

MAX_SAMPLES = 8
"""Largest number of samples along the longer axis of a footprint. Longer ones are blurred across, too."""

MIN_VIEW_COSINE = 0.02
"""Lower bound of the cosine between the view and the triangle's normal."""

NORMAL_UNIT = 1.0 / 32767.0
"""Factor of the integers of a normal map in an ``Atlas``."""

DIELECTRIC_REFLECTANCE = 0.04
"""Reflectance at normal incidence of what is no metal (glTF 2.0, appendix B.2.2: an index of refraction of 1.5)."""

MIN_ALPHA = 0.01
"""Smallest squared roughness. Sharper highlights would be smaller than the sun's disc, 0.0047 rad in radius."""


MAX_BEND = 0.18
"""Largest addition to the squared roughness by the bend of a surface within a pixel (A. Kaplanyan et al. 2016)."""


@compiled
def write_texture_rows(first, last, visible, atlas, albedo):
    """Replace the albedo (rows, cols, 3) of models by that of their textures, in the rows from ``first`` to before ``last``."""
    number, position, vertices, triangles, uv, color, material, eye, tangent = visible
    decode, texels, levels, texture, _, _, _, factors = atlas
    gradients, last_triangle = np.empty(20), np.int64(-1)  # neighbouring pixels mostly show the same triangle
    for i in range(first, last):
        for j in range(number.shape[1]):
            t = np.int64(number[i, j])
            if t < 0 or material[t] < 0:
                continue
            m = np.int64(material[t])
            if t != last_triangle:
                last_triangle = t
                _write_gradients(vertices, triangles, uv, t, gradients)
            place = _place(position, i, j, gradients, eye, tangent)
            red, green, blue = _corner_mix(color, t, place[0], place[1])
            if texture[m] >= 0:
                x, y, z = _filtered(texels, levels, texture[m], place, decode)
                red, green, blue = red * x, green * y, blue * z
            albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2] = factors[m, 0] * red, factors[m, 1] * green, factors[m, 2] * blue


@compiled
def sample_centroids(uv, color, material, atlas, albedo):
    """Write the albedo (m, 3) of triangles: the texture at the centroid, at the mip level with texels as large as the triangle.

    ``uv``, ``color`` and ``material`` are the arrays of a ``Surface``. Triangles without a material do not change.
    """
    decode, texels, levels, texture, _, _, _, factors = atlas
    third = 1.0 / 3.0
    for t in range(len(material)):
        m = np.int64(material[t])
        if m < 0:
            continue
        red, green, blue = _corner_mix(color, t, third, third)
        if texture[m] >= 0:
            height, width = levels[texture[m], 1], levels[texture[m], 2]
            u1, v1 = (uv[t, 1, 0] - uv[t, 0, 0]) * width, (uv[t, 1, 1] - uv[t, 0, 1]) * height
            u2, v2 = (uv[t, 2, 0] - uv[t, 0, 0]) * width, (uv[t, 2, 1] - uv[t, 0, 1]) * height
            blur = np.log2(max(np.sqrt(0.5 * abs(u1 * v2 - u2 * v1)), 1.0))
            u, v = (uv[t, 0, 0] + uv[t, 1, 0] + uv[t, 2, 0]) * third, (uv[t, 0, 1] + uv[t, 1, 1] + uv[t, 2, 1]) * third
            x, y, z = _trilinear(texels, levels, texture[m], u, v, blur, decode)
            red, green, blue = red * x, green * y, blue * z
        albedo[t, 0], albedo[t, 1], albedo[t, 2] = factors[m, 0] * red, factors[m, 1] * green, factors[m, 2] * blue


@internal
def _write_gradients(p, triangles, uv, t, out):
    """Write what the pixels of triangle ``t`` share to ``out`` (20,). The other parameters are those of ``VisibleTriangles``.

    The values are the first corner, the gradients of the barycentric weights of the second and the third corner, the unit
    normal, the gradients of both texture coordinates, and those coordinates at the first corner. Triangles without an area have
    gradients of 0.
    """
    a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    e1x, e1y, e1z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    e2x, e2y, e2z = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    e11, e12, e22 = e1x * e1x + e1y * e1y + e1z * e1z, e1x * e2x + e1y * e2y + e1z * e2z, e2x * e2x + e2y * e2y + e2z * e2z
    det = e11 * e22 - e12 * e12
    inverse = 1.0 / det if det > 0.0 else 0.0
    out[0], out[1], out[2] = p[a, 0], p[a, 1], p[a, 2]
    out[3], out[4], out[5] = (e22 * e1x - e12 * e2x) * inverse, (e22 * e1y - e12 * e2y) * inverse, (e22 * e1z - e12 * e2z) * inverse
    out[6], out[7], out[8] = (e11 * e2x - e12 * e1x) * inverse, (e11 * e2y - e12 * e1y) * inverse, (e11 * e2z - e12 * e1z) * inverse
    scale = np.sqrt(inverse)
    out[9], out[10], out[11] = (
        (e1y * e2z - e1z * e2y) * scale, (e1z * e2x - e1x * e2z) * scale, (e1x * e2y - e1y * e2x) * scale,
    )  # fmt: skip
    u0, v0 = np.float64(uv[t, 0, 0]), np.float64(uv[t, 0, 1])
    u1, v1, u2, v2 = uv[t, 1, 0] - u0, uv[t, 1, 1] - v0, uv[t, 2, 0] - u0, uv[t, 2, 1] - v0
    for k in range(3):
        out[12 + k] = u1 * out[3 + k] + u2 * out[6 + k]
        out[15 + k] = v1 * out[3 + k] + v2 * out[6 + k]
    out[18], out[19] = u0, v0


@internal
def _place(position, i, j, g, eye, tangent):
    """Return where the pixel (``i``, ``j``) lies on its triangle, of which ``g`` (20,) are the values of ``_write_gradients``.

    The values are the barycentric weights of the second and the third corner, the texture coordinates, and the two axes of the
    pixel's footprint in texture coordinates: across the line of sight and along it.
    """
    px, py, pz = position[i, j, 0], position[i, j, 1], position[i, j, 2]
    qx, qy, qz = px - g[0], py - g[1], pz - g[2]
    vx, vy, vz = px - eye[0], py - eye[1], pz - eye[2]
    distance = np.sqrt(vx * vx + vy * vy + vz * vz)
    nx, ny, nz = g[9], g[10], g[11]
    inverse = 1.0 / distance
    facing = (vx * nx + vy * ny + vz * nz) * inverse
    ax, ay, az = vx * inverse - facing * nx, vy * inverse - facing * ny, vz * inverse - facing * nz
    square = ax * ax + ay * ay + az * az
    if square < 1e-12:  # seen head-on: any direction in the triangle is along the line of sight
        ax, ay, az = g[3], g[4], g[5]
        square = max(ax * ax + ay * ay + az * az, 1e-300)
    width = tangent * distance
    across = width / np.sqrt(square)
    along = across / max(abs(facing), MIN_VIEW_COSINE)
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    return (
        g[3] * qx + g[4] * qy + g[5] * qz, g[6] * qx + g[7] * qy + g[8] * qz,
        g[18] + g[12] * qx + g[13] * qy + g[14] * qz, g[19] + g[15] * qx + g[16] * qy + g[17] * qz,
        across * (g[12] * bx + g[13] * by + g[14] * bz), across * (g[15] * bx + g[16] * by + g[17] * bz),
        along * (g[12] * ax + g[13] * ay + g[14] * az), along * (g[15] * ax + g[16] * ay + g[17] * az),
    )  # fmt: skip


@internal
def _corner_mix(values, t, s, w):
    """Return three values at a point from those at a triangle's corners (m, 3, 3), by the weights of the second and third one."""
    r = 1.0 - s - w
    return (
        r * values[t, 0, 0] + s * values[t, 1, 0] + w * values[t, 2, 0],
        r * values[t, 0, 1] + s * values[t, 1, 1] + w * values[t, 2, 1],
        r * values[t, 0, 2] + s * values[t, 1, 2] + w * values[t, 2, 2],
    )


@internal
def _filtered(texels, levels, texture, place, decode):
    """Return the mean of a texture over a pixel's footprint.

    ``texture`` is the first level, ``place`` that of ``_place``, and ``decode`` (256,) the values of bytes; empty for normals.
    """
    _, _, u, v, u1, v1, u2, v2 = place
    height, width = levels[texture, 1], levels[texture, 2]
    first = np.sqrt((u1 * width) ** 2 + (v1 * height) ** 2)
    second = np.sqrt((u2 * width) ** 2 + (v2 * height) ** 2)
    if first > second:
        first, second, u2, v2 = second, first, u1, v1
    count = min(max(np.int64(second / max(first, 1.0) + 0.5), 1), MAX_SAMPLES)
    blur = np.log2(max(first, second / count, 1.0))
    x, y, z = 0.0, 0.0, 0.0
    for n in range(count):
        share = (n + 0.5) / count - 0.5
        tx, ty, tz = _trilinear(texels, levels, texture, u + share * u2, v + share * v2, blur, decode)
        x, y, z = x + tx, y + ty, z + tz
    return x / count, y / count, z / count


@internal
def _trilinear(texels, levels, texture, u, v, blur, decode):
    """Return the texture at (``u``, ``v``), interpolated within and between mip levels. ``blur`` is the level, fractional."""
    blur = min(blur, levels[texture, 5] - 1.0)
    lower = np.int64(blur)
    x, y, z = _bilinear(texels, levels, texture + lower, u, v, decode)
    share = blur - lower
    if share > 0.0:
        cx, cy, cz = _bilinear(texels, levels, texture + lower + 1, u, v, decode)
        x, y, z = x + share * (cx - x), y + share * (cy - y), z + share * (cz - z)
    return x, y, z


@internal
def _bilinear(texels, levels, level, u, v, decode):
    """Return the mip level in row ``level`` of ``levels`` at (``u``, ``v``), interpolated between the centres of its texels."""
    first, height, width = levels[level, 0], levels[level, 1], levels[level, 2]
    x, y = u * width - 0.5, v * height - 0.5
    col, row = np.floor(x), np.floor(y)
    right, down = x - col, y - row
    c0, c1 = _wrapped(np.int64(col), width, levels[level, 3]), _wrapped(np.int64(col) + 1, width, levels[level, 3])
    r0, r1 = _wrapped(np.int64(row), height, levels[level, 4]), _wrapped(np.int64(row) + 1, height, levels[level, 4])
    a, b = np.uintp(first + r0 * width + c0), np.uintp(first + r0 * width + c1)
    c, d = np.uintp(first + r1 * width + c0), np.uintp(first + r1 * width + c1)
    wa, wb, wc, wd = (1.0 - down) * (1.0 - right), (1.0 - down) * right, down * (1.0 - right), down * right
    if decode.size:
        return (
            wa * decode[np.uintp(texels[a, 0])] + wb * decode[np.uintp(texels[b, 0])]
            + wc * decode[np.uintp(texels[c, 0])] + wd * decode[np.uintp(texels[d, 0])],
            wa * decode[np.uintp(texels[a, 1])] + wb * decode[np.uintp(texels[b, 1])]
            + wc * decode[np.uintp(texels[c, 1])] + wd * decode[np.uintp(texels[d, 1])],
            wa * decode[np.uintp(texels[a, 2])] + wb * decode[np.uintp(texels[b, 2])]
            + wc * decode[np.uintp(texels[c, 2])] + wd * decode[np.uintp(texels[d, 2])],
        )  # fmt: skip
    return (
        NORMAL_UNIT * (wa * texels[a, 0] + wb * texels[b, 0] + wc * texels[c, 0] + wd * texels[d, 0]),
        NORMAL_UNIT * (wa * texels[a, 1] + wb * texels[b, 1] + wc * texels[c, 1] + wd * texels[d, 1]),
        NORMAL_UNIT * (wa * texels[a, 2] + wb * texels[b, 2] + wc * texels[c, 2] + wd * texels[d, 2]),
    )


@internal
def _wrapped(index, count, mode):
    """Return the texel that serves an index outside of ``count`` texels: repeated (0), the nearest one (1), or mirrored (2)."""
    if 0 <= index < count:
        return index
    if mode == 1:
        return min(max(index, 0), count - 1)
    if mode == 2:
        index = index % (2 * count)
        return index if index < count else 2 * count - 1 - index
    return index % count


@compiled
def write_normal_rows(first, last, visible, atlas, normal):
    """Tilt the shading normals (rows, cols, 3) of models by their normal maps, in the rows from ``first`` to before ``last``.

    Red tilts the normal to the right of the picture on the triangle, green upwards (glTF 2.0, section 3.9.3). The tangents are
    those of the texture coordinates of each triangle.
    """
    number, position, p, triangles, uv, _, material, eye, tangent = visible
    _, _, _, _, normals, levels, normal_map, factors = atlas
    no_table, gradients, last_triangle = np.empty(0), np.empty(20), np.int64(-1)
    for i in range(first, last):
        for j in range(number.shape[1]):
            t = np.int64(number[i, j])
            if t < 0 or material[t] < 0 or normal_map[material[t]] < 0:
                continue
            m = np.int64(material[t])
            if t != last_triangle:
                last_triangle = t
                _write_gradients(p, triangles, uv, t, gradients)
            place = _place(position, i, j, gradients, eye, tangent)
            x, y, z = _filtered(normals, levels, normal_map[m], place, no_table)
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            e1x, e1y, e1z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
            e2x, e2y, e2z = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
            u1, v1 = uv[t, 1, 0] - uv[t, 0, 0], uv[t, 1, 1] - uv[t, 0, 1]
            u2, v2 = uv[t, 2, 0] - uv[t, 0, 0], uv[t, 2, 1] - uv[t, 0, 1]
            det = np.float64(u1) * v2 - np.float64(u2) * v1
            if det == 0.0:
                continue
            tx, ty, tz = (v2 * e1x - v1 * e2x) / det, (v2 * e1y - v1 * e2y) / det, (v2 * e1z - v1 * e2z) / det
            bx, by, bz = (u2 * e1x - u1 * e2x) / det, (u2 * e1y - u1 * e2y) / det, (u2 * e1z - u1 * e2z) / det
            nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
            along = tx * nx + ty * ny + tz * nz
            tx, ty, tz = tx - along * nx, ty - along * ny, tz - along * nz
            length = np.sqrt(tx * tx + ty * ty + tz * tz)
            if length == 0.0:
                continue
            tx, ty, tz = tx / length, ty / length, tz / length
            cx, cy, cz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
            scale = factors[m, 3]
            faces = nx * (e1y * e2z - e1z * e2y) + ny * (e1z * e2x - e1x * e2z) + nz * (e1x * e2y - e1y * e2x)
            if faces < 0.0:  # the back side, whose normal is turned to the eye
                scale = -scale
            x, y = scale * x, scale * y
            if cx * bx + cy * by + cz * bz < 0.0:
                y = -y
            nx, ny, nz = x * tx + y * cx + z * nx, x * ty + y * cy + z * ny, x * tz + y * cz + z * nz
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 0.0:
                normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = nx / length, ny / length, nz / length


@compiled
def write_gloss_rows(first, last, visible, atlas, normal, to_sun, gloss):
    """Write the sunlight that glossy models mirror (rows, cols, 4), in the rows from ``first`` to before ``last``.

    The channels are those of the stage ``gloss``. ``normal`` (rows, cols, 3) are the shading normals, ``to_sun`` (3,) is the
    direction to the sun. Reflectance is that of Schlick (1994) for an index of refraction of 1.5 and for metals.
    """
    number, position, vertices, triangles, uv, color, material, eye, tangent = visible
    decode, texels, levels, texture, normals, normal_levels, normal_map, factors = atlas
    no_table, gradients, last_triangle = np.empty(0), np.empty(20), np.int64(-1)
    for i in range(first, last):
        for j in range(number.shape[1]):
            t = np.int64(number[i, j])
            if t < 0 or material[t] < 0 or factors[material[t], 6] == 0.0:
                continue
            m = np.int64(material[t])
            nx, ny, nz = normal[i, j, 0], normal[i, j, 1], normal[i, j, 2]
            cos_sun = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
            vx, vy, vz = eye[0] - position[i, j, 0], eye[1] - position[i, j, 1], eye[2] - position[i, j, 2]
            distance = np.sqrt(vx * vx + vy * vy + vz * vz)
            hx, hy, hz = vx / distance + to_sun[0], vy / distance + to_sun[1], vz / distance + to_sun[2]
            length = np.sqrt(hx * hx + hy * hy + hz * hz)
            if cos_sun <= 0.0 or length < 1e-6:
                continue
            half_cosine = max((nx * hx + ny * hy + nz * hz) / length, 0.0)
            grazing = (1.0 - min(max((to_sun[0] * hx + to_sun[1] * hy + to_sun[2] * hz) / length, 0.0), 1.0)) ** 5
            bend = _bend(number, material, position, normal, i, j, 3.0 * tangent * distance)
            alpha = max(factors[m, 4] ** 2, MIN_ALPHA)
            exponent = 2.0 / min(alpha * alpha + min(0.5 * bend, MAX_BEND), 1.0) - 2.0
            metallic = factors[m, 5]
            red, green, blue = 1.0, 1.0, 1.0
            if normal_map[m] >= 0 or metallic > 0.0:
                if t != last_triangle:
                    last_triangle = t
                    _write_gradients(vertices, triangles, uv, t, gradients)
                place = _place(position, i, j, gradients, eye, tangent)
                if normal_map[m] >= 0:
                    x, y, z = _filtered(normals, normal_levels, normal_map[m], place, no_table)
                    exponent = toksvig_exponent(exponent, np.sqrt(x * x + y * y + z * z))
                if metallic > 0.0:
                    red, green, blue = _corner_mix(color, t, place[0], place[1])
                    if texture[m] >= 0:
                        x, y, z = _filtered(texels, levels, texture[m], place, decode)
                        red, green, blue = red * x, green * y, blue * z
            lobe = blinn_phong(exponent, half_cosine) * cos_sun
            base = DIELECTRIC_REFLECTANCE
            red = base + metallic * (factors[m, 0] * red - base)
            green = base + metallic * (factors[m, 1] * green - base)
            blue = base + metallic * (factors[m, 2] * blue - base)
            gloss[i, j, 0] = (red + (1.0 - red) * grazing) * lobe
            gloss[i, j, 1] = (green + (1.0 - green) * grazing) * lobe
            gloss[i, j, 2] = (blue + (1.0 - blue) * grazing) * lobe
            gloss[i, j, 3] = metallic + (1.0 - metallic) * (base + (1.0 - base) * grazing)


@compiled
def blinn_phong(exponent, half_cosine):
    """Return the Blinn-Phong lobe times pi, normalised so that all light at normal incidence is reflected.

    ``half_cosine`` is the cosine between the normal and the half vector. The norm is that of F. Giesen (2009, "Phong normalization
    factor derivations"). With the exponent 0 it is Lambert's law.
    """
    norm = (exponent + 2.0) * (exponent + 4.0) / (8.0 * (2.0 ** (-0.5 * exponent) + exponent))
    return norm * half_cosine**exponent


@compiled
def toksvig_exponent(exponent, mean_length):
    """Return the exponent of a highlight on normals whose mean has a length below 1.

    The normals spread within the pixel, and so does the highlight (M. Toksvig 2005, "Mipmapping normal maps").
    """
    length = min(mean_length, 1.0)
    return exponent * length / (length + exponent * (1.0 - length))


@internal
def _bend(number, material, position, normal, i, j, max_distance_m):
    """Return the squared change of the normal from pixel to pixel, from the neighbours on the same material.

    Highlights widen by it (A. Kaplanyan et al. 2016, "Filtering distributions of normals for shading antialiasing"), so that small
    curved parts do not glitter. ``max_distance_m`` excludes neighbours behind an edge, and those of samples, which lie elsewhere.
    """
    rows, cols = number.shape
    m = material[number[i, j]]
    total = 0.0
    for axis in range(2):
        row, col = i + (1 - axis), j + axis
        if row >= rows or col >= cols:
            row, col = max(i - (1 - axis), 0), max(j - axis, 0)
        t = number[row, col]
        if t < 0 or material[t] != m:
            continue
        distance = 0.0
        change = 0.0
        for k in range(3):
            distance += (position[row, col, k] - position[i, j, k]) ** 2
            change += (normal[row, col, k] - normal[i, j, k]) ** 2
        if distance <= max_distance_m * max_distance_m:
            total += change
    return total
