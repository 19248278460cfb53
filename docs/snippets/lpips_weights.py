import re
from pathlib import Path

import lpips
import numpy as np

arrays = {name: value.numpy() for name, value in lpips.LPIPS(net="vgg").state_dict().items()}
folder = Path("WEIGHTS")
folder.mkdir(exist_ok=True)
heads = {f"lin{k}": arrays[f"lin{k}.model.1.weight"].ravel() for k in range(5)}
np.savez(folder / "lpips_lin_vgg16.npz", **heads)
of_vgg = [name for name in arrays if name.startswith("net.")]
features = {re.sub(r"^net\.slice\d", "features", name): arrays[name] for name in of_vgg}
np.savez(folder / "vgg16_features.npz", **features)
