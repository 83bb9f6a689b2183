"""Who may ask the page's server, and what it serves: nothing but the photos of the object and its scene."""

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect
from support.user_project import Project

from scenefuse.pick.pick import Guard, add_pictures
from scenefuse.pick.session import Session

TOKEN, PORT = "a-secret", 8123
HERE = f"http://127.0.0.1:{PORT}"


@pytest.fixture
def session(tmp_path, monkeypatch):
    project = Project(tmp_path)
    project.photos("flight", 2)
    project.photos("close", 3)
    cv2.imwrite(str(tmp_path / "close/Füße und Kopf.jpg"), np.zeros((300, 700, 3), dtype=np.uint8))
    (tmp_path / "secret.jpg").write_bytes((tmp_path / "close/0.jpg").read_bytes())
    project.write()
    monkeypatch.chdir(tmp_path)
    return Session("shed", (tmp_path / "mine.yaml",))


@pytest.fixture
def client(session):
    app = FastAPI()
    app.add_middleware(Guard, token=TOKEN, port=PORT)
    add_pictures(app, session)

    @app.websocket("/socket")
    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text("hello")
        await websocket.close()

    with TestClient(app, base_url=HERE) as client:
        yield client


def enter(client):
    assert client.get(f"/nothing?token={TOKEN}").status_code == 404


@pytest.mark.parametrize(
    "address", ["/", "/tile/0/0/0/0/0", "/thumbnail/0/0", "/?token=", "/?token=wrong", "/?token=é"]
)
def test_without_the_token_nothing_is_served(client, address):
    refused = client.get(address)
    assert refused.status_code == 403 and TOKEN not in refused.text and "set-cookie" not in refused.headers


def test_the_token_in_the_address_becomes_a_cookie_that_scripts_and_other_sites_do_not_get(client):
    given = client.get(f"/thumbnail/0/0?token={TOKEN}")
    assert given.status_code == 200
    assert "HttpOnly" in given.headers["set-cookie"] and "SameSite=Strict" in given.headers["set-cookie"]
    assert client.get("/thumbnail/0/0").status_code == 200


@pytest.mark.parametrize("header", [{"host": f"evil.example:{PORT}"}, {"origin": "http://evil.example"}])
def test_other_names_and_other_sites_are_refused_even_with_the_token(client, header):
    enter(client)
    assert client.get(f"/thumbnail/0/0?token={TOKEN}", headers=header).status_code == 403


def test_a_websocket_needs_the_cookie_and_its_own_site(client):
    headers = {"host": f"127.0.0.1:{PORT}"}
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/socket", headers=headers):
        pass
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"/socket?token={TOKEN}", headers=headers):
        pass
    headers["cookie"] = f"scenefuse_pick_{PORT}={TOKEN}"
    with client.websocket_connect("/socket", headers=headers) as socket:
        assert socket.receive_text() == "hello"
    evil = headers | {"origin": "http://evil.example"}
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/socket", headers=evil):
        pass


@pytest.mark.parametrize(
    "address",
    [
        "/thumbnail/0/../../secret.jpg",
        "/thumbnail/0/%2e%2e%2f%2e%2e%2fsecret.jpg",
        "/thumbnail/0/secret.jpg",
        "/tile/0/..%2f..%2f..%2fetc%2fpasswd/0/0/0",
        "/tile/0//etc/passwd",
        "/secret.jpg",
        "/close/0.jpg",
        "/thumbnail/0/-1",
        "/thumbnail/0/4",
        "/thumbnail/3/0",
        "/thumbnail/-1/0",
        "/tile/0/0/0/1/0",
    ],
)
def test_no_address_leads_out_of_the_photos(client, address):
    enter(client)
    assert client.get(address).status_code in (404, 422)


def test_photos_with_spaces_and_umlauts_are_served(client, session):
    enter(client)
    number = list(session.tables[0].pictures).index("Füße und Kopf.jpg")
    tile = client.get(f"/tile/0/{number}/2/2/1")
    assert tile.status_code == 200 and cv2.imdecode(np.frombuffer(tile.content, np.uint8), 1).shape == (256, 256, 3)
    thumbnail = client.get(f"/thumbnail/0/{number}")
    assert cv2.imdecode(np.frombuffer(thumbnail.content, np.uint8), 1).shape == (137, 320, 3)


def test_a_photo_that_vanished_is_not_found(client, session):
    enter(client)
    for picture in session.tables[0].pictures.values():
        picture.path.unlink()
    assert client.get("/thumbnail/0/0").status_code == client.get("/tile/0/0/0/0/0").status_code == 404
