/** Saves files and copies texts to the clipboard. */

import type { Service } from './service';

/** Fetches and saves a file under a name. Throws as `Service.request` does. */
export async function saveFile(service: Service, address: string, name: string, signal?: AbortSignal): Promise<void> {
  const response = await service.request(address, { signal });
  const url = URL.createObjectURL(await response.blob());
  const link = document.createElement('a');
  link.href = url;
  link.download = name;
  link.click();
  // The browser reads it after the click.
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** A button that copies a text, and says that it did. */
export function copyButton(text: () => string, what: string): HTMLButtonElement {
  const button = document.createElement('button');
  button.type = 'button';
  button.className = 'plain copy';
  button.textContent = 'Copy';
  button.setAttribute('aria-label', `Copy ${what}`);
  button.addEventListener('click', async () => {
    try {
      await navigator.clipboard.writeText(text());
      button.textContent = 'Copied';
    } catch {
      // Without HTTPS browsers keep their clipboard: the text can be marked and copied by hand.
      button.textContent = 'Mark it and press Ctrl+C';
    }
    setTimeout(() => { button.textContent = 'Copy'; }, 2500);
  });
  return button;
}
