"""How good a splat is: PSNR, SSIM, LPIPS, and what the training views cover."""
