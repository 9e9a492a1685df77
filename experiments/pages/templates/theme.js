// The switch between light and dark; without a choice the page follows the system's setting.
{
  const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)");
  const announce = () => root.dispatchEvent(new Event("theme"));
  document.querySelector(".theme").addEventListener("click", () => {
    root.dataset.theme = (root.dataset.theme ?? (dark.matches ? "dark" : "light")) === "dark" ? "light" : "dark";
    announce();
  });
  dark.addEventListener("change", announce);
}
