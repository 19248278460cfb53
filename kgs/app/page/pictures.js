"use strict";
// The slider below a photo uncovers the render over it, from the right. It follows a pointer over the photo.

for (const range of document.querySelectorAll(".wipe input")) {
  const over = range.closest("figure").querySelector(".over");
  const renders = range.closest(".view").querySelectorAll("img.render");
  over.src = renders[renders.length - 1].src;  // that of the last run
  const uncover = () => {
    over.style.clipPath = `inset(0 0 0 ${range.value}%)`;
  };
  range.addEventListener("input", uncover);
  const pair = range.closest("figure").querySelector(".pair");
  pair.addEventListener("pointermove", (event) => {
    const { left, width } = pair.getBoundingClientRect();
    range.value = 100 * (event.clientX - left) / width;
    uncover();
  });
  uncover();
}
