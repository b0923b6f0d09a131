/** A view's picture in a dialog over the page. For levels with a place on earth its day can be played there. */

import { html } from '../dom';
import { saveFile } from '../saved';
import { type Service, inWords } from '../service';
import { Picture } from './snapshot';
import { type DayOfView, ViewDay } from './view_day';

/** Opens a picture; Escape closes it. `name` is that of its file, without a suffix; `day` lets the sun move. */
export function openPicture(service: Service, title: string, address: string, name: string, day: DayOfView | null): void {
  const picture = new Picture(service, title);
  const viewDay = day && new ViewDay(service, day, title, name, () => picture.element.clientWidth, (frame) => {
    picture.covered();
    picture.element.append(frame);
  });
  const said = html('span', { role: 'status' });
  const save = html('button', {
    type: 'button',
    onclick: async () => {
      try {
        // Another time of the day may be seen meanwhile.
        await saveFile(service, day && viewDay ? day.address(viewDay.state, 'png', null) : address, `${name}.png`);
      } catch (error) {
        said.textContent = inWords(error);
      }
    },
  }, 'Save');
  const close = html('button', { type: 'button', onclick: () => dialog.close() }, 'Close');
  const dialog = html('dialog', { class: 'whole-picture', 'aria-label': title },
    html('header', {}, html('h2', {}, title), said, save, close), picture.element, viewDay?.element);
  dialog.addEventListener('click', (event) => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener('close', () => {
    viewDay?.close();
    picture.close();
    dialog.remove();
  });
  document.body.append(dialog);
  dialog.showModal();
  void picture.show(address);
}
