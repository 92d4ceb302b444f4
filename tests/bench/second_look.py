"""Does a second look, at the object alone and as large as the network knows it, find more in photographs?

python tests/bench/second_look.py WEIGHTS OBJECT FOLDER
"""
import sys, time, cv2, numpy as np, torch, dataclasses
from torch.nn import functional as F
from pathlib import Path
torch.set_num_threads(1)
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.learn.heads import Outputs
from mmgsd.measure.photographs import *
import mmgsd.measure.photographs as mp

class Second(Matcher):
    least, most, margin, present_of = 1.25, 3.0, 1.35, "first"
    @torch.inference_mode()
    def describe(self, images):
        firsts = super().describe(images)
        return [self.again(im, f) for im, f in zip(images, firsts)]
    def plan(self, image, first):
        size = self.compute_input_size(image)
        m = first.mask.sigmoid().cpu().numpy()
        m = (m > 0.5).astype(np.uint8)
        n, lab, stats, _ = cv2.connectedComponentsWithStats(m)
        if n < 2: return None
        big = stats[1:, 4].max()
        keep = [k for k in range(1, n) if stats[k, 4] > 0.15 * big]
        ys, xs = np.nonzero(np.isin(lab, keep))
        h, w = m.shape
        x0, x1, y0, y1 = xs.min() / w, (xs.max() + 1) / w, ys.min() / h, (ys.max() + 1) / h
        share = self.margin * max(x1 - x0, y1 - y0)
        s = min(self.most, 1 / share)
        if s < self.least: return None
        st = 2 * self.network.stride
        full = [int(round(v * s / st)) * st for v in size]
        off = []
        for c, fu, si in zip(((x0 + x1) / 2, (y0 + y1) / 2), full, size):
            o = int(round((c * fu - si / 2) / st)) * st
            off.append(int(np.clip(o, 0, fu - si)))
        return size, full, off
    def again(self, image, first):
        p = self.plan(image, first)
        if p is None: return first
        size, full, off = p
        big = cv2.resize(image, full, interpolation=cv2.INTER_AREA if full[0] < image.shape[1] else cv2.INTER_LINEAR)
        crop = big[off[1]:off[1] + size[1], off[0]:off[0] + size[0]]
        batch = torch.from_numpy(np.ascontiguousarray(crop)).permute(2, 0, 1)[None].float() / 255
        said = self._say(batch).split()[0]
        def embed(a, b):
            f = size[0] // b.shape[-1]
            shape = (full[1] // f, full[0] // f)
            lead = a[None] if a.ndim == 3 else a[None, None]
            whole = F.interpolate(lead, shape, mode="bilinear", align_corners=False)
            oy, ox = off[1] // f, off[0] // f
            whole[..., oy:oy + b.shape[-2], ox:ox + b.shape[-1]] = b
            return whole[0] if a.ndim == 3 else whole[0, 0]
        return Outputs(embed(first.descriptors, said.descriptors), embed(first.mask, said.mask), embed(first.surface, said.surface), first.present)

if __name__ == "__main__":
    file, o = sys.argv[1], sys.argv[2]
    kinds = {"plain": Matcher, "second": Second}
    for name in kinds:
        m = kinds[name].load(find_weights(file), device="cpu"); m.object = o
        t = time.time()
        r = measure_answers(m, read_photographs(sys.argv[3], o), progress=False)
        print(name, {k: r[k] for k in ("queries", "unanswered", *MEASURES)}, "%.0f s" % (time.time() - t), flush=True)
