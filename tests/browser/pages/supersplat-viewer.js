import { defaultSettings } from '@playcanvas/supersplat-viewer/settings.js'
import { createViewer } from '@playcanvas/supersplat-viewer/viewer.js'
import * as pc from 'playcanvas'
import { canvas, drawToTexture, drawUntil, nextFrame, readPixels, readTexture } from './common.js'
import { isSorted, isStreamed, levelsOf } from './playcanvas.js'

const STYLE = import.meta.resolve('@playcanvas/supersplat-viewer/viewer.css')

// The viewer itself, with the settings that it has without a file of them. `renderer`: webgpu, its default, or webgl. Others are its own, such as aa.
export async function start({ renderer = 'webgpu', ...settings }) {
  const target = renderer === 'webgpu' && drawToTexture()
  document.head.append(Object.assign(document.createElement('link'), { rel: 'stylesheet', href: STYLE }))
  let container = canvas
  let viewer = null
  let view = null
  let asked = false

  // The viewer turns a file by half a turn about z, for most have y down.
  function pose(eye) {
    const world = new pc.Mat4().set(view.viewmat.map((value, i) => (i < 8 ? -value : value))).invert()
    eye.setPosition(world.getTranslation())
    eye.setRotation(new pc.Quat().setFromMat4(world))
    eye.camera.clearColor = new pc.Color(...view.background, 1)
    eye.camera.horizontalFov = false // distances of levels are for its field of view
    eye.camera.fov = (2 * Math.atan(1 / view.projection[5]) * 180) / Math.PI
    // The viewer sets its own in each frame, of which the engine makes a matrix before it asks `calculateProjection`.
    eye.camera.camera._evaluateProjectionMatrix = function () {
      this._projMat.set(view.projection)
    }
  }

  return {
    // `streamed`: what our playcanvas.json says of a streamed file; without it the viewer shows what it would.
    async open(url, streamed = {}) {
      viewer?.destroy()
      view = null
      const place = Object.assign(document.createElement('div'), { style: 'position: relative; width: 100px; height: 100px' })
      container.replaceWith(place)
      container = place
      viewer = await createViewer({ container, settings: defaultSettings(), contentUrl: url, ui: false, renderer, ...settings })
      const { app } = viewer
      if (app.graphicsDevice.isWebGPU !== Boolean(target)) throw new Error(`this browser has no ${renderer}`)
      app.on('update', () => view && pose(app.root.findByName('camera'))) // after the viewer's own, which places its camera anew
      app.on('framerender', () => {
        if (!view) return
        app.renderNextFrame = asked // and not in each frame: a software GPU would fall behind
        asked = false
      })
      if (streamed.lodBaseDistance) viewer.events.once('loaded:changed', () => apply(app, streamed))
      while (!viewer.state.loaded) await nextFrame()
      app.scene.gsplat.colorUpdateAngle = 0 // a viewer in motion reuses colors
    },

    async draw(wanted) {
      view = wanted
      Object.assign(container.style, { width: `${view.width}px`, height: `${view.height}px` })
      const { app } = viewer
      const { graphicsDevice: device } = app
      const eye = app.root.findByName('camera')
      const frame = () => {
        asked = true
        return new Promise((resolve) => app.once('frameend', resolve))
      }
      while (device.width !== view.width || device.height !== view.height) await frame()
      await drawUntil(() => isSorted(app, eye), frame)
      await drawUntil(() => isStreamed(app, eye), frame)
      await drawUntil(() => isSorted(app, eye), frame)
      return target ? readTexture(target) : readPixels(device.gl, view)
    },

    levels: () => levelsOf(viewer.app, viewer.app.root.findByName('camera')),
  }
}

// As docs/streaming.md says.
function apply(app, { lodBaseDistance, lodMultiplier, splatBudgetMode, splatBudget, lodUpdateDistance }) {
  Object.assign(app.scene.gsplat, { splatBudgetMode, splatBudget, lodUpdateDistance })
  Object.assign(app.root.findComponent('gsplat'), { lodBaseDistance, lodMultiplier })
  app.renderNextFrame = true
}
