"""The first prototype of the splatting kernel, frozen: the baseline of benchmarks/splat.py.

Do not improve it. It goes away once the kernel's speed goals, which are ratios to it, have been reached and recorded.
Tiles of 8x4 pixels, counting sorts, persistent lanes; `forward` and `backward` are lanes and list entries an iteration.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

AMIN, AMAX, TEPS = 1 / 255.0, 0.99, 1e-4


def rasterize(
    means,
    quats,
    scales,
    opacities,
    colors,
    view,
    intrinsics,
    width,
    height,
    *,
    capacity=None,
    forward=(128, 16),
    backward=(128, 8),
    tw=8,
    th=4,
):
    """Image (h, w, 3) over black, alpha (h, w, 1), and the number of intersections and of those dropped.

    means (n, 3) metres, quats (n, 4) as (w, x, y, z), scales (n, 3) metres, opacities (n,), colors (n, 3), view (4, 4)
    world to camera, intrinsics (3, 3) pixels. capacity: room for intersections, five a Gaussian by default.
    """
    capacity = capacity or 5 * means.shape[0]
    mx, my, a, b, c, cxx, cyy, z, ok = _project(means, quats, scales, view, intrinsics, width, height)
    logo = jnp.log(opacities)
    stopped = [lax.stop_gradient(x) for x in (mx, my, cxx, cyy, z, ok, logo)]
    gs, starts, ends, total, dropped = _binning(*stopped, width, height, tw, th, capacity)
    tab = jnp.stack([mx, my, -0.5 * a, -b, -0.5 * c, logo, colors[:, 0], colors[:, 1], colors[:, 2]], 1)
    tab = jnp.concatenate([tab, jnp.asarray([[0, 0, 0, 0, 0, -1e9, 0, 0, 0]], jnp.float32)])
    out = _make_blend(width, tw, th, forward, backward)(tab, gs, starts, ends)
    tx, ty = -(-width // tw), -(-height // th)
    img = out.reshape(ty, tx, 4, th, tw).transpose(0, 3, 1, 4, 2).reshape(ty * th, tx * tw, 4)[:height, :width]
    return img[..., :3], 1 - img[..., 3:], (total, dropped)


def _project(means, quats, scales, view, intrinsics, width, height, eps2d=0.3, near=0.01):
    rot, t = view[:3, :3], view[:3, 3]
    q = quats / jnp.linalg.norm(quats, axis=-1, keepdims=True)
    w, x, y, z = q[:, 0], q[:, 1], q[:, 2], q[:, 3]
    m00, m01, m02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    m10, m11, m12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    m20, m21, m22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    p = [means[:, 0] * rot[i, 0] + means[:, 1] * rot[i, 1] + means[:, 2] * rot[i, 2] + t[i] for i in range(3)]
    ok = p[2] > near
    zc = jnp.where(ok, p[2], 1.0)
    rz = 1 / zc
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    tfx, tfy = 0.5 * width / fx, 0.5 * height / fy
    lxp, lxn = (width - cx) / fx + 0.3 * tfx, cx / fx + 0.3 * tfx
    lyp, lyn = (height - cy) / fy + 0.3 * tfy, cy / fy + 0.3 * tfy
    tx, ty = zc * jnp.clip(p[0] * rz, -lxn, lxp), zc * jnp.clip(p[1] * rz, -lyn, lyp)
    j00, j02, j11, j12 = fx * rz, -fx * tx * rz * rz, fy * rz, -fy * ty * rz * rz
    u = [j00 * rot[0, i] + j02 * rot[2, i] for i in range(3)]
    v = [j11 * rot[1, i] + j12 * rot[2, i] for i in range(3)]

    def col(c, s):
        return (u[0] * c[0] + u[1] * c[1] + u[2] * c[2]) * s, (v[0] * c[0] + v[1] * c[1] + v[2] * c[2]) * s

    a0, b0 = col((m00, m10, m20), scales[:, 0])
    a1, b1 = col((m01, m11, m21), scales[:, 1])
    a2, b2 = col((m02, m12, m22), scales[:, 2])
    cxx, cyy = a0 * a0 + a1 * a1 + a2 * a2 + eps2d, b0 * b0 + b1 * b1 + b2 * b2 + eps2d
    cxy = a0 * b0 + a1 * b1 + a2 * b2
    inv = 1 / (cxx * cyy - cxy * cxy)
    return fx * p[0] * rz + cx, fy * p[1] * rz + cy, cyy * inv, -cxy * inv, cxx * inv, cxx, cyy, p[2], ok


def _fcumsum(x):
    n, block = x.shape[0], 128
    nb = -(-n // block)
    y = jnp.pad(x, (0, nb * block - n)).reshape(nb, block).astype(jnp.float32)
    inn = jnp.dot(y, jnp.triu(jnp.ones((block, block), jnp.float32), 1), precision="highest")
    tot = y.sum(1)
    if nb > block:
        off = _fcumsum(tot.astype(jnp.int32)).astype(jnp.float32)
    else:
        off = jnp.dot(tot, jnp.triu(jnp.ones((nb, nb), jnp.float32), 1), precision="highest")
    return (inn + off[:, None]).reshape(-1)[:n].astype(jnp.int32)


def _stable_digit_pass(digit, nd, payload, columns):
    n = digit.shape[0]
    rows = -(-n // columns)
    d = jnp.pad(digit, (0, rows * columns - n), constant_values=nd - 1).reshape(columns, rows)
    sl = d + jnp.arange(columns, dtype=jnp.int32)[:, None] * nd

    def body(cnt, s):
        cnt = cnt.at[s].add(1, unique_indices=True, mode="promise_in_bounds")
        return cnt, cnt[s]

    cnt, rank = lax.scan(body, jnp.zeros(columns * nd, jnp.int32), sl.T)
    base = _fcumsum(cnt.reshape(columns, nd).T.reshape(-1)).reshape(nd, columns).T.reshape(-1)
    pos = (base[sl] + rank.T - 1).reshape(-1)[:n]
    return [jnp.zeros_like(p).at[pos].set(p, unique_indices=True, mode="drop") for p in payload], base[:nd]


def _depth_order(depth, ok, bits=12, columns=32):
    kb = lax.bitcast_convert_type(depth, jnp.int32)
    mn = jnp.min(jnp.where(ok, kb, jnp.int32(2**31 - 1)))
    rngk = jnp.max(jnp.where(ok, kb, mn)) - mn + 1
    k = jnp.where(ok, kb - mn, rngk)
    npass = (32 - lax.clz(rngk) + bits - 1) // bits

    def step(i, c):
        k, idx = c
        digit = lax.shift_right_logical(k, i * bits) & ((1 << bits) - 1)
        (k, idx), _ = _stable_digit_pass(digit, 1 << bits, [k, idx], columns)
        return k, idx

    return lax.fori_loop(0, npass, step, (k, jnp.arange(depth.shape[0], dtype=jnp.int32)))[1]


def _binning(mx, my, cxx, cyy, depth, ok, logo, width, height, tw, th, m):
    n, tx, ty = mx.shape[0], -(-width // tw), -(-height // th)
    r2 = 2 * (logo - np.log(AMIN))
    r = jnp.sqrt(jnp.maximum(r2, 0))

    def span(c, e, t, n):
        lo = jnp.clip(jnp.ceil((c - e - 0.5 - (t - 1)) / t), 0, n).astype(jnp.int32)
        hi = jnp.clip(jnp.floor((c + e - 0.5) / t) + 1, 0, n).astype(jnp.int32)
        return lo, jnp.maximum(hi, lo)

    x0, x1 = span(mx, r * jnp.sqrt(cxx), tw, tx)
    y0, y1 = span(my, r * jnp.sqrt(cyy), th, ty)
    vis = ok & (r2 > 0)
    nt = jnp.where(vis, (x1 - x0) * (y1 - y0), 0)
    order = _depth_order(depth, vis & (nt > 0))
    pk = jnp.stack([nt, x0 + (y0 << 15), jnp.maximum(x1 - x0, 1)], 1)[order]
    nts = pk[:, 0]
    start = _fcumsum(nts)
    total = start[-1] + nts[-1]
    mark = jnp.zeros(m, jnp.int32).at[jnp.where(nts > 0, start, m)].add(1, mode="drop")
    rank = jnp.clip(_fcumsum(mark) + mark - 1, 0, n - 1)
    info = jnp.stack([start, pk[:, 1], pk[:, 2], order], 1)[rank]
    j = jnp.arange(m, dtype=jnp.int32) - info[:, 0]
    w = info[:, 2]
    jy = ((j.astype(jnp.float32) + 0.5) / w.astype(jnp.float32)).astype(jnp.int32)
    tile = ((info[:, 1] >> 15) + jy) * tx + (info[:, 1] & 32767) + j - jy * w
    tile = jnp.where(jnp.arange(m) < total, tile, tx * ty)
    (gs,), bounds = _stable_digit_pass(tile, tx * ty + 1, [info[:, 3]], 64)
    return gs, bounds[:-1], bounds[1:], total, jnp.maximum(total - m, 0)


def _alpha(q, px, py, ox, oy):
    dx, dy = px - (q[0] - ox)[..., None], py - (q[1] - oy)[..., None]
    pw = q[5][..., None] + (q[2][..., None] * dx + q[3][..., None] * dy) * dx + (q[4][..., None] * dy) * dy
    y = jnp.clip(pw, -6.0, 0.0) * (1 / 16)
    y2 = y * y
    a, b = 120 + 12 * y2, y * (60 + y2)
    r = (a + b) / (a - b)
    r = r * r
    r = r * r
    r = r * r
    e = r * r
    return jnp.where(e >= AMIN, jnp.minimum(e, AMAX), 0.0)


def _prep(start, end, lanes):
    t = start.shape[0]
    cnt = end - start
    order = jnp.argsort(-cnt).astype(jnp.int32)
    order = jnp.where(jnp.arange(t) < jnp.sum(cnt > 0), order, t)
    return jnp.pad(order, (0, 2 * lanes), constant_values=t), jnp.pad(start, (0, 1)), jnp.pad(end, (0, 1))


def _consts(width, tw, th):
    p = tw * th
    x, y = np.arange(p) % tw + 0.5, np.arange(p) // tw + 0.5
    return p, -(-width // tw), jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)


def _refill(done, tile, nxt, order):
    k = jnp.cumsum(done.astype(jnp.int32), dtype=jnp.int32) - 1 + nxt
    nt = order[jnp.minimum(k, order.shape[0] - 1)]
    return jnp.where(done, nt, tile), nxt + jnp.sum(done, dtype=jnp.int32)


def _forward(tab, gs, start, end, width, tw, th, lanes, steps):
    p, tx, px, py = _consts(width, tw, th)
    t, m, n = start.shape[0], gs.shape[0], tab.shape[0] - 1
    order, st, en = _prep(start, end, lanes)
    sl, lane = jnp.arange(steps, dtype=jnp.int32)[:, None], jnp.arange(lanes, dtype=jnp.int32)
    out = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1.0], jnp.float32)[None, :, None], (t + lanes, 4, p))

    def body(c):
        tile, pos, tr, c0, c1, c2, nxt, out = c
        e0 = en[tile]
        ox, oy = ((tile % tx) * tw).astype(jnp.float32), ((tile // tx) * th).astype(jnp.float32)
        ii = pos[None] + sl
        par = tab[jnp.where(ii < e0[None], gs[jnp.minimum(ii, m - 1)], n)]
        q = [par[..., k] for k in range(9)]
        al = _alpha(q, px, py, ox, oy)
        om = 1 - al
        cs = []
        for ch, acc in ((6, c0), (7, c1), (8, c2)):
            col = q[ch][..., None]
            h = al[steps - 1] * col[steps - 1]
            for k in range(steps - 2, -1, -1):
                h = h + al[k] * (col[k] - h)
            cs.append(acc + tr * h)
        tn = tr
        for k in range(steps):
            tn = tn * om[k]
        pos = pos + steps
        done = ((pos >= e0) | (jnp.max(tn, axis=-1) <= TEPS)) & (tile < t)
        place = jnp.where(done, tile, t + lane)
        out = out.at[place].set(jnp.stack([*cs, tn], 1), unique_indices=True, mode="promise_in_bounds")
        tile2, nxt = _refill(done, tile, nxt, order)
        d = done[:, None]
        cs = [jnp.where(d, 0.0, x) for x in cs]
        return tile2, jnp.where(done, st[tile2], pos), jnp.where(d, 1.0, tn), *cs, nxt, out

    t0 = order[:lanes]
    z = jnp.zeros((lanes, p), jnp.float32)
    first = (t0, st[t0], z + 1, z, z, z, jnp.int32(lanes), out)
    return lax.while_loop(lambda c: jnp.any(c[0] < t), body, first)[-1][:t]


def _backward(tab, gs, start, end, blended, cotangent, width, tw, th, lanes, steps):
    p, tx, px, py = _consts(width, tw, th)
    t, m, n = start.shape[0], gs.shape[0], tab.shape[0] - 1
    order, st, en = _prep(start, end, lanes)
    sl = jnp.arange(steps, dtype=jnp.int32)[:, None]
    r0 = jnp.pad(jnp.sum(blended * cotangent, 1), ((0, 1), (0, 0)))
    vp = jnp.pad(cotangent[:, :3], ((0, 1), (0, 0), (0, 0)))
    xn, yn = np.arange(p) % tw + 0.5 - tw / 2, np.arange(p) // tw + 0.5 - th / 2
    mono = jnp.asarray(np.stack([np.ones(p), xn, yn, xn * xn, xn * yn, yn * yn], 1), jnp.float32)

    def body(c):
        tile, pos, tr, r, nxt, grad = c
        e0 = en[tile]
        ox, oy = ((tile % tx) * tw).astype(jnp.float32), ((tile // tx) * th).astype(jnp.float32)
        v = vp[tile]
        ii = pos[None] + sl
        ids = jnp.where(ii < e0[None], gs[jnp.minimum(ii, m - 1)], n)
        par = tab[ids]
        q = [par[..., k] for k in range(9)]
        al = _alpha(q, px, py, ox, oy)
        tn, ws, gp = tr, [], []
        for k in range(steps):
            w = tn * al[k]
            ws.append(w)
            tn = tn * (1 - al[k])
            wd = w * (q[6][k][:, None] * v[:, 0] + q[7][k][:, None] * v[:, 1] + q[8][k][:, None] * v[:, 2])
            r = r - wd
            gp.append(jnp.where(al[k] < AMAX, wd - r * (al[k] / (1 - al[k])), 0.0))
        w, gp = jnp.stack(ws), jnp.stack(gp)
        mom = jnp.dot(gp.reshape(steps * lanes, p), mono).reshape(steps, lanes, 6)
        vc = jnp.matmul(w.transpose(1, 0, 2), v.transpose(0, 2, 1)).transpose(1, 0, 2)
        lx, ly = q[0] - (ox + tw / 2), q[1] - (oy + th / 2)
        a, b, cc = -2 * q[2], -q[3], -2 * q[4]
        m0, m1, m2, m3, m4, m5 = (mom[..., k] for k in range(6))
        sdx, sdy = m1 - lx * m0, m2 - ly * m0
        sxx, syy = m3 - 2 * lx * m1 + lx * lx * m0, m5 - 2 * ly * m2 + ly * ly * m0
        sxy = m4 - lx * m2 - ly * m1 + lx * ly * m0
        geometry = [a * sdx + b * sdy, b * sdx + cc * sdy, sxx, sxy, syy, m0]
        row = jnp.stack([*geometry, vc[..., 0], vc[..., 1], vc[..., 2]], -1)
        grad = grad.at[ids.reshape(-1)].add(row.reshape(-1, 9), mode="promise_in_bounds")
        pos = pos + steps
        done = ((pos >= e0) | (jnp.max(tn, axis=-1) <= TEPS)) & (tile < t)
        tile2, nxt = _refill(done, tile, nxt, order)
        d = done[:, None]
        return tile2, jnp.where(done, st[tile2], pos), jnp.where(d, 1.0, tn), jnp.where(d, r0[tile2], r), nxt, grad

    t0 = order[:lanes]
    zeros, ones = jnp.zeros((n + 1, 9), jnp.float32), jnp.ones((lanes, p), jnp.float32)
    first = (t0, st[t0], ones, r0[t0], jnp.int32(lanes), zeros)
    return lax.while_loop(lambda c: jnp.any(c[0] < t), body, first)[-1]


def _make_blend(width, tw, th, forward, backward):
    @jax.custom_vjp
    def blend(tab, gs, st, en):
        return _forward(tab, gs, st, en, width, tw, th, *forward)

    def fwd(tab, gs, st, en):
        out = _forward(tab, gs, st, en, width, tw, th, *forward)
        return out, (tab, gs, st, en, out)

    def bwd(saved, cotangent):
        *lists, out = saved
        return _backward(*lists, out, cotangent, width, tw, th, *backward), None, None, None

    blend.defvjp(fwd, bwd)
    return blend
