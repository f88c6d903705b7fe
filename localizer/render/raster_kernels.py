"""The loops of the CPU renderer, compiled by numba, outside the GIL.

Images are flat here. Indices are unsigned, which spares numba's test for negative ones.
"""

# ruff: noqa: PLR0912, PLR0915 (kernels pass arrays and unroll, for speed)

from __future__ import annotations

import numpy as np
from numba import njit

_SLACK = 1e-7  # of barycentric weights
_NARROW = 6  # pixels: in narrower triangles every pixel is tried, wider ones are cut by division
_LANES = 0x1FFF | 0x1FFF << 21 | 0x1FFF << 42  # 13 of 21 bits each


@njit(cache=True, nogil=True, fastmath=True)
def clear(rgb, depth, sky, begin, end):  # type: ignore[no-untyped-def]
    """Set sky colour and zero depth in the flat pixels from begin to end."""
    red, green, blue = sky[0], sky[1], sky[2]
    for i in range(np.uint64(begin), np.uint64(end)):
        depth[i] = np.float32(0)
        at = np.uint64(3) * i
        rgb[at] = red
        rgb[at + np.uint64(1)] = green
        rgb[at + np.uint64(2)] = blue


@njit(cache=True, nogil=True)
def depth_from_inverse(depth, begin, end):  # type: ignore[no-untyped-def]
    """1/z to z in place, in the flat pixels from begin to end; 0 stays."""
    for i in range(np.uint64(begin), np.uint64(end)):
        if depth[i] > np.float32(0):
            depth[i] = np.float32(1) / depth[i]


@njit(cache=True, nogil=True, fastmath=True)
def project(positions, T, intrinsics, near, screen):  # type: ignore[no-untyped-def]
    """Project vertices to (x, y, 1/z) in pixels and 1/m; 1/z is -1 before the near plane."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for i in range(positions.shape[0]):
        px, py, pz = positions[i, 0], positions[i, 1], positions[i, 2]
        z = r20 * px + r21 * py + r22 * pz + t2
        if z < near:
            screen[i, 2] = np.float32(-1)
        else:
            k = np.float32(1) / z
            screen[i, 0] = (r00 * px + r01 * py + r02 * pz + t0) * k * fx + cx
            screen[i, 1] = (r10 * px + r11 * py + r12 * pz + t1) * k * fy + cy
            screen[i, 2] = k


@njit(cache=True, nogil=True, fastmath=True)
def list_faces(screen, faces, width, strip_of_row, listed, counts):  # type: ignore[no-untyped-def]
    """List the faces that may cover a pixel centre, in the row of `listed` (S, F) of every strip
    that they reach, with their numbers in `counts` (S,). Returns the number of faces that cross the
    near plane; they are at the end of row 0.
    """
    half = np.float32(0.5)
    height = strip_of_row.shape[0]
    right, bottom = np.float32(width) - half, np.float32(height) - half
    crossing = 0
    last = listed.shape[1] - 1
    counts[:] = 0
    for f in range(faces.shape[0]):
        a, b, c = np.uint64(faces[f, 0]), np.uint64(faces[f, 1]), np.uint64(faces[f, 2])
        ia, ib, ic = screen[a, 2], screen[b, 2], screen[c, 2]
        if ia < 0 or ib < 0 or ic < 0:
            if ia > 0 or ib > 0 or ic > 0:
                listed[0, last - crossing] = f
                crossing += 1
            continue
        xa, xb, xc = screen[a, 0], screen[b, 0], screen[c, 0]
        x0, x1 = min(xa, xb, xc), max(xa, xb, xc)
        if x1 < half or x0 > right or np.ceil(x0 - half) > np.floor(x1 - half):
            continue
        ya, yb, yc = screen[a, 1], screen[b, 1], screen[c, 1]
        y0, y1 = min(ya, yb, yc), max(ya, yb, yc)
        if y1 < half or y0 > bottom:
            continue
        first, end = np.ceil(y0 - half), np.floor(y1 - half)
        if first > end:
            continue
        top = strip_of_row[np.uint64(max(first, np.float32(0)))]
        low = strip_of_row[np.uint64(min(end, np.float32(height - 1)))]
        for strip in range(top, low + 1):
            listed[strip, counts[strip]] = f
            counts[strip] += 1
    return crossing


@njit(cache=True, nogil=True)
def clip(positions, uvs, faces, crossing, T, intrinsics, near):  # type: ignore[no-untyped-def]
    """Cut faces at the near plane to one or two triangles each: their corners as `project` gives
    them (3 m, 3), and texture coordinates (3 m, 2). crossing: indices of the faces.
    """
    screen = np.empty((6 * crossing.shape[0], 3), np.float32)
    cut_uvs = np.empty((6 * crossing.shape[0], 2), np.float32)
    corner = np.empty((3, 5), np.float32)  # camera x, y, z, then u, v
    polygon = np.empty((4, 5), np.float32)
    n = 0
    for i in range(crossing.shape[0]):
        for k in range(3):
            v = faces[crossing[i], k]
            for axis in range(3):
                corner[k, axis] = (
                    T[axis, 0] * positions[v, 0]
                    + T[axis, 1] * positions[v, 1]
                    + T[axis, 2] * positions[v, 2]
                    + T[axis, 3]
                )
            corner[k, 3], corner[k, 4] = uvs[v, 0], uvs[v, 1]
        count = 0
        for k in range(3):
            here, after = corner[k], corner[(k + 1) % 3]
            if here[2] >= near:
                polygon[count] = here
                count += 1
            if (here[2] >= near) != (after[2] >= near):
                s = (near - here[2]) / (after[2] - here[2])
                for q in range(5):
                    polygon[count, q] = here[q] + s * (after[q] - here[q])
                polygon[count, 2] = near
                count += 1
        for third in range(2, count):
            for k in (0, third - 1, third):
                inverse = np.float32(1) / polygon[k, 2]
                screen[n, 0] = polygon[k, 0] * inverse * intrinsics[0] + intrinsics[2]
                screen[n, 1] = polygon[k, 1] * inverse * intrinsics[1] + intrinsics[3]
                screen[n, 2] = inverse
                cut_uvs[n, 0], cut_uvs[n, 1] = polygon[k, 3], polygon[k, 4]
                n += 1
    return screen[:n], cut_uvs[:n]


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _spread(texel):  # type: ignore[no-untyped-def]
    """Put RGB bytes into three lanes of 21 bits, so that one multiplication weights all."""
    return (
        (texel & np.uint64(0xFF))
        | (texel & np.uint64(0xFF00)) << np.uint64(13)
        | (texel & np.uint64(0xFF0000)) << np.uint64(26)
    )


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _row_blend(pair, weight):  # type: ignore[no-untyped-def]
    """Blend a texel and its right neighbour, which has `weight` (of 256); lanes of 13 bits."""
    left, right = _spread(pair), _spread(pair >> np.uint64(24))
    both = left * (np.uint64(256) - weight) + right * weight
    return both >> np.uint64(3) & np.uint64(_LANES)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _span(b, c, whole, db, dc, across):  # type: ignore[no-untyped-def]
    """First and last k of 0 to `across`: b + k db >= 0, c + k dc >= 0, their sum <= whole."""
    begin, end = 0.0, np.float64(across)
    dl, rest = -db - dc, whole - b - c
    if db != 0.0:
        k = -b / db
        begin, end = (max(begin, k), end) if db > 0.0 else (begin, min(end, k))
    elif b < 0.0:
        end = -1.0
    if dc != 0.0:
        k = -c / dc
        begin, end = (max(begin, k), end) if dc > 0.0 else (begin, min(end, k))
    elif c < 0.0:
        end = -1.0
    if dl != 0.0:
        k = -rest / dl
        begin, end = (max(begin, k), end) if dl > 0.0 else (begin, min(end, k))
    elif rest < 0.0:
        end = -1.0
    return int(np.ceil(begin)), int(np.floor(end))


@njit(cache=True, nogil=True, fastmath=True)
def fill(  # type: ignore[no-untyped-def]
    screen, uvs, faces, listed, repeat, pairs, offsets, sizes, rgb, inverse_depth, width, y0, y1
):
    """Fill the listed faces within rows y0 to y1. rgb, inverse_depth: flat; the latter holds the
    nearest 1/z so far.
    """
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    quarter = np.float32(0.25)
    fixed = np.float32(256)
    top, bottom = np.float32(y0) + half, np.float32(y1) - half
    levels = sizes.shape[0]
    finest = np.float64(sizes[0, 0]) * np.float64(sizes[0, 1])
    level, shrink = 0, one  # shrink: 4 ** -level
    w, h = np.uint64(sizes[0, 0]), np.uint64(sizes[0, 1])
    base = np.uint64(offsets[0])
    fw, fh = np.float32(w), np.float32(h)
    for i in range(listed.shape[0]):
        f = np.uint64(listed[i])
        a, b, c = np.uint64(faces[f, 0]), np.uint64(faces[f, 1]), np.uint64(faces[f, 2])
        ya, yb, yc = screen[a, 1], screen[b, 1], screen[c, 1]
        low, high = min(ya, yb, yc), max(ya, yb, yc)
        if high < top or low > bottom:
            continue
        xa, xb, xc = screen[a, 0], screen[b, 0], screen[c, 0]
        first_x = max(0, int(np.ceil(min(xa, xb, xc) - half)))
        last_x = min(width - 1, int(np.floor(max(xa, xb, xc) - half)))
        first_y = max(y0, int(np.ceil(low - half)))
        last_y = min(y1 - 1, int(np.floor(high - half)))

        # Set up in float64: corners of large triangles lie thousands of pixels outside the image,
        # where float32 would cost millimetres of depth. Along a row all is linear, for float32.
        ax, ay = np.float64(xa), np.float64(ya)
        bx, by, cx, cy = xb - ax, yb - ay, xc - ax, yc - ay
        area = bx * cy - cx * by
        if area == 0.0:
            continue
        ia, ib, ic = screen[a, 2], screen[b, 2], screen[c, 2]
        across = last_x - first_x
        narrow = across < _NARROW
        sign = 1.0 if area > 0.0 else -1.0
        slack, whole = _SLACK * area * sign, (1.0 + _SLACK) * area * sign
        db, dc = cy * sign, -by * sign
        px = first_x + 0.5 - ax
        prepared = textured = False
        for y in range(first_y, last_y + 1):
            py = y + 0.5 - ay
            # Weights of b and c, times the area: a pixel is inside where none is negative and
            # their sum does not exceed it. The slack is for rounding: neighbours leave no crack.
            eb, ec = (cy * px - cx * py) * sign, (bx * py - by * px) * sign
            if narrow:  # most triangles: by trying every pixel, without divisions or branches
                kb, kc, kl = eb + slack, ec + slack, whole - eb - ec
                first = count = 0
                for _ in range(across + 1):
                    inside = int(min(kb, kc, kl) >= 0.0)
                    count += inside
                    first += int(count == 0)
                    kb += db
                    kc += dc
                    kl -= db + dc
                if count == 0:
                    continue
                last = first + count - 1
            else:
                first, last = _span(eb + slack, ec + slack, whole + 2 * slack, db, dc, across)
                if first > last:
                    continue
            eb += first * db
            ec += first * dc
            if not prepared:
                prepared = True
                inverse_area = 1.0 / area
                iab = np.float64(ib - ia) * inverse_area * sign
                iac = np.float64(ic - ia) * inverse_area * sign
                d_iz = np.float32(db * iab + dc * iac)
            row_iz = np.float32(ia + eb * iab + ec * iac)
            sampled = False
            p = np.uint64(y * width + first_x + first)
            for k in range(last - first + 1):
                t = np.float32(k)
                iz = row_iz + t * d_iz
                if iz <= inverse_depth[p]:
                    p += np.uint64(1)
                    continue
                inverse_depth[p] = iz
                if not sampled:  # most listed faces show no pixel and never come here
                    sampled = True
                    if not textured:
                        textured = True
                        ua, va = np.float64(uvs[a, 0]), np.float64(uvs[a, 1])
                        ub, vb = np.float64(uvs[b, 0]) - ua, np.float64(uvs[b, 1]) - va
                        uc, vc = np.float64(uvs[c, 0]) - ua, np.float64(uvs[c, 1]) - va
                        # Texels per pixel, as an area: the Jacobian of the perspective map is this
                        # constant times z^3.
                        texel_area = np.float32(
                            abs((ub * vc - uc * vb) * inverse_area) * finest * ia * ib * ic
                        )
                        # u / z and v / z are linear in the image.
                        scale_b = ib * inverse_area * sign
                        scale_c = ic * inverse_area * sign
                        ub, vb, uc, vc = ub * scale_b, vb * scale_b, uc * scale_c, vc * scale_c
                        du, dv = np.float32(db * ub + dc * uc), np.float32(db * vb + dc * vc)
                        u0, v0 = np.float32(ua), np.float32(va)
                    row_u = np.float32(eb * ub + ec * uc)
                    row_v = np.float32(eb * vb + ec * vc)
                z = one / iz
                footprint = texel_area * z * z * z * shrink
                if footprint > np.float32(2) or footprint < half:
                    while level < levels - 1 and footprint > np.float32(2):
                        level += 1
                        shrink *= quarter
                        footprint *= quarter
                    while level > 0 and footprint < half:
                        level -= 1
                        shrink *= np.float32(4)
                        footprint *= np.float32(4)
                    w, h = np.uint64(sizes[level, 0]), np.uint64(sizes[level, 1])
                    base = np.uint64(offsets[level])
                    fw, fh = np.float32(w), np.float32(h)
                u = (row_u + t * du) * z + u0
                v = (row_v + t * dv) * z + v0
                if repeat:
                    u -= np.floor(u)
                    v -= np.floor(v)
                iu = np.uint64(np.int32(min(max(u * fw - half, zero), fw - one) * fixed))
                iv = np.uint64(np.int32(min(max(v * fh - half, zero), fh - one) * fixed))
                wu, wv = iu & np.uint64(255), iv & np.uint64(255)
                iu, iv = iu >> np.uint64(8), iv >> np.uint64(8)
                # At the last column and row the second texel has no weight; past the last row
                # there may be no memory.
                q = base + iv * w + iu
                below = q + w if iv + np.uint64(1) < h else q
                colour = _row_blend(pairs[q], wu) * (np.uint64(256) - wv)
                colour += _row_blend(pairs[below], wu) * wv
                at = np.uint64(3) * p
                rgb[at] = np.uint8(colour >> np.uint64(13))
                rgb[at + np.uint64(1)] = np.uint8(colour >> np.uint64(34))
                rgb[at + np.uint64(2)] = np.uint8(colour >> np.uint64(55))
                p += np.uint64(1)
