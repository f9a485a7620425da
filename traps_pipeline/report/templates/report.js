// Saves a picture of the page as it is, or drawn as a PNG.
document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-save]");
  if (!button) return;
  const image = document.getElementById(button.dataset.of);
  const link = document.createElement("a");
  link.download = button.dataset.save;
  link.href = image.src;
  if (link.download.endsWith(".png")) {
    const canvas = document.createElement("canvas");
    const scale = image.src.startsWith("data:image/svg") ? 4 : 1; // of a drawing without pixels
    canvas.width = scale * image.naturalWidth;
    canvas.height = scale * image.naturalHeight;
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    link.href = canvas.toDataURL("image/png");
  }
  link.click();
});
