// A link to a collapsed table opens it, also from another page and when it was closed again.
function unfold(address) {
  const part = document.getElementById(decodeURIComponent(address.slice(1)));
  if (part instanceof HTMLDetailsElement) part.open = true;
}
document.addEventListener("click", (event) => {
  const link = event.target.closest("a[href^='#']");
  if (link) unfold(link.hash);
});
window.addEventListener("hashchange", () => unfold(location.hash));
unfold(location.hash);

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
