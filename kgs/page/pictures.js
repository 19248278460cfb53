"use strict";
// The slider below a photo lays the render over it, from the right.

for (const range of document.querySelectorAll(".wipe input")) {
  const over = range.closest("figure").querySelector(".over");
  over.src = [...range.closest(".view").querySelectorAll("img.render")].pop().src;  // of the last fit
  const wipe = () => { over.style.clipPath = `inset(0 0 0 ${range.value}%)`; };
  range.addEventListener("input", wipe);
  wipe();
}
