"use strict";
// Reads out the numbers of a panel: on hover, on tap, and by the arrow keys.
(() => {
  const readout = document.getElementById("readout");
  let lit = null;
  const hide = () => {
    if (lit) lit.classList.remove("on");
    lit = null;
    readout.hidden = true;
  };
  const place = () => {
    if (!lit) return;
    const at = lit.getBoundingClientRect();
    readout.hidden = at.bottom < 0 || at.top > innerHeight;
    const box = readout.getBoundingClientRect();
    const wide = document.documentElement.clientWidth, room = 8;
    let left = at.right + room;
    if (left + box.width > wide - room) left = at.left - box.width - room;
    if (left < room) left = Math.max(room, Math.min(at.left, wide - box.width - room));
    const top = Math.max(room, Math.min(at.top, innerHeight - box.height - room));
    readout.style.left = `${left}px`;
    readout.style.top = `${top}px`;
  };
  const show = (tip) => {
    if (lit === tip) return;
    hide();
    lit = tip;
    tip.classList.add("on");
    readout.textContent = tip.dataset.tip;
    place();
  };
  for (const svg of document.querySelectorAll("svg.panel")) {
    const tips = [...svg.querySelectorAll(".tip")];
    for (const tip of tips) {
      const title = tip.querySelector("title");
      tip.dataset.tip = title.textContent;
      title.remove();
    }
    const under = (event) => {
      const tip = event.target.closest(".tip");
      if (tip) show(tip); else hide();
    };
    svg.addEventListener("pointermove", under);
    svg.addEventListener("pointerdown", under);
    svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hide(); });
    svg.addEventListener("blur", hide);
    svg.addEventListener("keydown", (event) => {
      if (event.key === "Escape") return hide();
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step || !tips.length) return;
      event.preventDefault();
      const from = tips.indexOf(lit);
      show(tips[from < 0 ? (step > 0 ? 0 : tips.length - 1) : (from + step + tips.length) % tips.length]);
    });
  }
  addEventListener("scroll", place, { passive: true });
})();
