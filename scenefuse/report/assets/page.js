for (const range of document.querySelectorAll(".range")) {
  const slider = range.previousElementSibling;
  const move = (percent) => {
    range.value = percent;
    slider.style.setProperty("--cut", percent + "%");
  };
  range.addEventListener("input", () => move(range.value));
  slider.addEventListener("pointermove", (event) => {
    if (event.pointerType === "touch" && !event.isPrimary) return;
    const box = slider.getBoundingClientRect();
    move(Math.min(100, Math.max(0, ((event.clientX - box.left) / box.width) * 100)));
  });
}
